//! Preemptive concurrencies, and states with a timeout or a `while` condition, which become such concurrencies.
//!
//! This is the only clock of the reference: actions take the durations of the oracle, everything else takes no time. In a race, each region
//! is first evaluated alone to find its end, which gives the moment when the race is decided; then all are evaluated again up to that
//! moment. The present action of each remaining region is then cut short, and the region leaves its states.
//!
//! There is no verdict if regions share anything, or if two ends are so close that the durations of everything else matter.

use super::evaluate::Read;
use super::{Fail, Reference, fails};
use ratn_model::expression::{EffectExpr, Expr};
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, Nature, PREEMPTED, SUCCESS, State, StateKind, VIOLATED, WORLD_MODEL};
use ratn_model::resource::ResourceOperation;
use ratn_model::value::Value;
use ratn_model::wait::Wait;
use std::collections::BTreeSet;

/// Upper limit of all durations, together, that count as no time here.
const CLOSE_S: f64 = 400.0;

type Variables = Vec<(String, Value)>;

/// Conditions that must hold, with the variables in their scope.
type Watch = (Vec<Expr>, Variables);

/// The races around a thread of control, and what has happened in them.
#[derive(Debug, Clone, Default)]
pub(super) struct Races {
    /// Seconds since the outermost race began.
    now_s: f64,
    /// Possible delay: regions inside of one node take turns with blocked resources, and their order is not known here.
    late_s: f64,
    /// When the first of them is decided, and its number; the outermost is 0.
    until: Option<(f64, usize)>,
    /// The watch of every race.
    watches: Vec<Option<Watch>>,
    /// The race that cut this thread short.
    cut: Option<Cut>,
    /// Whether something failed on the way out.
    pub(super) has_failed: bool,
}

impl Races {
    fn latest_s(&self) -> f64 {
        self.now_s + self.late_s
    }

    /// Continues after a `finally`: its duration counts, nothing else of it.
    pub(super) fn resume(&mut self, cut: Races) {
        *self = Races { now_s: self.now_s, late_s: self.late_s, ..cut };
    }
}

/// The regions of a concurrency that waits for all of them, evaluated one after another.
pub(super) struct Beside {
    races: Races,
    is_leaving: bool,
    end_s: f64,
    late_s: f64,
    /// The durations of all regions added up.
    together_s: f64,
    has_failed: bool,
    cut: Option<Option<Cut>>,
}

impl Beside {
    /// Begins the next region.
    pub(super) fn begin(&mut self, reference: &mut Reference<'_>) {
        self.end_s = self.end_s.max(reference.races.now_s);
        self.late_s = self.late_s.max(reference.races.late_s);
        self.together_s += reference.races.latest_s() - self.races.latest_s();
        (reference.races, reference.is_leaving) = (self.races.clone(), self.is_leaving);
    }

    /// Notes that a region was cut short.
    pub(super) fn is_cut(&mut self, reference: &mut Reference<'_>, regions: usize) -> Result<(), Fail> {
        if regions > 1 && reference.races.cut.is_some_and(|cut| cut.watch.is_some()) {
            // Where the other regions are at that moment is not known here.
            return Err(Fail::NotMine("regions that are watched"));
        }
        self.has_failed |= reference.races.has_failed;
        self.cut = Some(reference.races.cut);
        Ok(())
    }

    /// Ends the concurrency.
    pub(super) fn end(mut self, reference: &mut Reference<'_>, regions: &[StateId]) -> Result<(), Fail> {
        self.begin(reference);
        (reference.races.now_s, reference.races.late_s) = (self.end_s, self.late_s);
        if !self.races.watches.is_empty() && reference.take_turns(regions) {
            let latest_s = self.races.latest_s() + self.together_s;
            let until = self.races.until.filter(|_| !self.is_leaving);
            if until.is_some_and(|(until_s, _)| latest_s + CLOSE_S > until_s) {
                return Err(Fail::NotMine("regions that take turns until a race is decided"));
            }
            reference.races.late_s = latest_s - self.end_s;
        }
        if self.cut.is_none() && regions.len() > 1 && reference.is_broken() {
            // A condition may have become false while another region was running.
            return Err(Fail::NotMine("regions that are watched"));
        }
        let Some(cut) = self.cut else { return Ok(()) };
        reference.races.has_failed |= self.has_failed;
        Err(reference.cut(cut))
    }
}

/// A race that was decided while an action was running.
#[derive(Debug, Clone, Copy)]
struct Cut {
    race: usize,
    /// The outcome of its watch, if the watch decided it.
    watch: Option<&'static str>,
}

/// The result of evaluating a region.
struct Region {
    outcome: String,
    end_s: f64,
    late_s: f64,
    /// The race that cut it short; `Some(None)` if the run was told to end.
    cut: Option<Option<Cut>>,
    has_failed: bool,
}

impl Reference<'_> {
    /// Cuts the thread short if a watch around it is broken, before anything begins.
    pub(super) fn is_watched(&mut self) -> Result<(), Fail> {
        if self.is_leaving {
            return Ok(());
        }
        for race in 0..self.races.watches.len() {
            let Some(watch) = self.races.watches[race].clone() else { continue };
            if let Some(outcome) = self.broken(&watch)? {
                return Err(self.cut(Some(Cut { race, watch: Some(outcome) })));
            }
        }
        Ok(())
    }

    /// Whether a watch around the thread is broken.
    fn is_broken(&self) -> bool {
        !self.is_leaving && self.races.watches.iter().flatten().any(|watch| self.broken(watch) != Ok(None))
    }

    /// An action runs for this duration.
    pub(super) fn takes(&mut self, seconds: f64) -> Result<(), Fail> {
        self.is_watched()?;
        if self.races.watches.is_empty() {
            return Ok(());
        }
        let end_s = self.races.now_s + seconds;
        if let Some((until_s, race)) = self.races.until.filter(|_| !self.is_leaving) {
            let may_end = |end_s: f64| (end_s - until_s).abs() < CLOSE_S;
            let late_s = self.races.late_s;
            let may_be_either = late_s > 0.0 && (end_s < until_s) != (end_s + late_s < until_s);
            let may_not_have_begun = late_s > 0.0 && end_s > until_s && self.races.now_s + late_s + CLOSE_S > until_s;
            if may_end(end_s) || may_end(end_s + late_s) || may_be_either || may_not_have_begun {
                return Err(Fail::NotMine("what ends as a race does"));
            }
            if end_s > until_s {
                self.races.now_s = until_s;
                return Err(self.cut(Some(Cut { race, watch: None })));
            }
        }
        self.races.now_s = end_s;
        Ok(())
    }

    /// Begins the regions of a concurrency.
    pub(super) fn beside(&self) -> Beside {
        let (races, is_leaving, end_s) = (self.races.clone(), self.is_leaving, self.races.now_s);
        Beside { races, is_leaving, end_s, late_s: 0.0, together_s: 0.0, has_failed: false, cut: None }
    }

    /// Cuts the present action short because the run is told to end.
    pub(super) fn cut_by_the_run(&mut self) -> Fail {
        self.cut(None)
    }

    fn cut(&mut self, cut: Option<Cut>) -> Fail {
        self.races.cut = cut;
        self.is_leaving = true;
        Fail::Cut
    }

    /// Whether the thread leaves its states because of a race.
    pub(super) fn has_lost(&self) -> bool {
        self.is_leaving && self.races.cut.is_some()
    }

    /// The outcome with which a watch ends, if it is broken.
    fn broken(&self, (holds, variables): &Watch) -> Result<Option<&'static str>, Fail> {
        for holds in holds {
            match fails(holds.is_true(&self.place(variables, None)))? {
                Ok(true) => {}
                Ok(false) => return Ok(Some(VIOLATED)),
                Err(_) => return Ok(Some(ABORTED)),
            }
        }
        Ok(None)
    }

    /// A preemptive concurrency; returns its outcome, or `None` if it is violated before anything in it begins.
    pub(super) fn race(
        &mut self,
        state: &State,
        path: &str,
        variables: &mut Variables,
        in_routine: bool,
    ) -> Result<Option<String>, Fail> {
        let StateKind::Concurrency { regions, .. } = &state.kind else { return Err(Fail::NotMine("a race of one")) };
        let program = self.program;
        let is_body = |region: &&StateId| !program.state(**region).is_watch();
        let bodies: Vec<StateId> = regions.iter().filter(is_body).copied().collect();
        match bodies.as_slice() {
            [body] if regions.len() > 1 => self.limited(state, *body, path, variables, in_routine),
            [_, _, ..] if bodies.len() == regions.len() => self.first_of(state, path, variables, in_routine).map(Some),
            _ => Err(Fail::NotMine("a race of another kind")),
        }
    }

    /// A state with a timeout, a watch or both.
    fn limited(
        &mut self,
        state: &State,
        body: StateId,
        path: &str,
        variables: &mut Variables,
        in_routine: bool,
    ) -> Result<Option<String>, Fail> {
        let program = self.program;
        let StateKind::Concurrency { regions, .. } = &state.kind else { return Ok(None) };
        let (mut watch, mut limit_s): (Option<Watch>, Option<f64>) = (None, None);
        for region in regions {
            match program.state(*region).wait() {
                Some(Wait::Watch(holds)) => watch = Some((holds.into_iter().cloned().collect(), variables.clone())),
                Some(Wait::Limit(seconds)) => match seconds.read(&self.place(variables, None))? {
                    Value::Float(seconds) => limit_s = Some(seconds),
                    _ => return Err(Fail::NotMine("a limit of another kind")),
                },
                _ => {}
            }
        }
        if let Some(watch) = &watch
            && let Some(outcome) = self.broken(watch)?
        {
            self.ends(regions, |region| if region == body { PREEMPTED } else { outcome });
            return Ok((outcome != VIOLATED).then(|| outcome.to_owned()));
        }
        let number = self.races.watches.len();
        let until = limit_s.map(|seconds| (self.races.now_s + seconds, number));
        let (outer, is_leaving) = (self.races.clone(), self.is_leaving);
        let within = within(&outer, is_leaving, until, watch);
        let end = self.region(body, path, variables, in_routine, &within)?;
        let outcome = match end.cut {
            None => end.outcome.clone(),
            Some(Some(cut)) if cut.race == number => cut.watch.unwrap_or(ABORTED).to_owned(),
            Some(by) => {
                self.after(outer, is_leaving, &[end])?;
                return Err(self.cut(by));
            }
        };
        let is_timed = |region: StateId| matches!(program.state(region).wait(), Some(Wait::Limit(_)));
        let decided = end.cut.flatten();
        self.ends(regions, |region| match decided {
            _ if region == body => &end.outcome,
            Some(Cut { watch: None, .. }) if is_timed(region) => ABORTED,
            Some(Cut { watch: Some(outcome), .. }) if !is_timed(region) => outcome,
            _ => PREEMPTED,
        });
        self.after(outer, is_leaving, &[end])?;
        Ok(Some(outcome))
    }

    /// Regions of which the first to end decides the race, or the required number of successes.
    fn first_of(
        &mut self,
        state: &State,
        path: &str,
        variables: &mut Variables,
        in_routine: bool,
    ) -> Result<String, Fail> {
        let StateKind::Concurrency { regions, decide, successes, .. } = &state.kind else {
            return Err(Fail::NotMine("a race of one"));
        };
        if self.choices.is_some() && !self.is_leaving {
            return Err(Fail::NotMine("a run told to end that has races"));
        }
        if !self.outside.is_empty() || self.touch(regions) {
            return Err(Fail::NotMine("regions that race for the same"));
        }
        let number = self.races.watches.len();
        let (outer, is_leaving) = (self.races.clone(), self.is_leaving);
        let by_itself = within(&outer, is_leaving, None, None);
        // The ends of the regions evaluated alone, in the order of time.
        let mut ends: Vec<(f64, usize, String)> = Vec::new();
        for (place, region) in regions.iter().enumerate() {
            let before = (self.result.clone(), self.outputs.clone(), self.regions.clone());
            let end = self.region(*region, path, &mut variables.clone(), in_routine, &by_itself)?;
            (self.result, self.outputs, self.regions) = before;
            if end.late_s > outer.late_s {
                return Err(Fail::NotMine("regions that take turns in a race"));
            }
            match end.cut {
                None => ends.push((end.end_s, place, end.outcome)),
                Some(Some(Cut { watch: None, .. })) => {}
                Some(_) => return Err(Fail::NotMine("a watch around a race")),
            }
        }
        ends.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (mut first, mut enough) = (None, None);
        let mut succeeded = 0;
        for (past, (at_s, place, outcome)) in ends.iter().enumerate() {
            succeeded += u32::from(outcome == SUCCESS);
            let going_on = (regions.len() - past - 1) as u32;
            let is_decided = successes.is_none_or(|wanted| succeeded >= wanted || succeeded + going_on < wanted);
            if is_decided {
                first = Some((*at_s, *place));
                enough = successes.map(|wanted| succeeded >= wanted);
                break;
            }
        }
        let until = first.map(|(at_s, _)| (at_s, number));
        let is_close = |at_s: f64| until.is_some_and(|(until_s, _)| (at_s - until_s).abs() < CLOSE_S);
        let others = ends.iter().filter(|(_, place, _)| first.is_some_and(|(_, first)| first != *place));
        if others.map(|(at_s, ..)| *at_s).chain(outer.until.map(|(at_s, _)| at_s)).any(is_close) {
            return Err(Fail::NotMine("ends that are close to each other"));
        }
        // All regions again, up to the decision.
        let before = variables.clone();
        let mut all = Vec::new();
        for (place, region) in regions.iter().enumerate() {
            let has_ended = ends.iter().any(|(at_s, of, _)| *of == place && until.is_some_and(|(t, _)| *at_s <= t));
            let within = within(&outer, is_leaving, until.filter(|_| !has_ended), None);
            let mut own = before.clone();
            all.push(self.region(*region, path, &mut own, in_routine, &within)?);
            merge(variables, &before, own);
        }
        let by_what_is_around =
            all.iter().find_map(|end| end.cut.filter(|cut| cut.is_none_or(|cut| cut.race != number)));
        self.after(outer, is_leaving, &all)?;
        if let Some(by) = by_what_is_around {
            return Err(self.cut(by));
        }
        let Some((_, first)) = first else { return Err(Fail::NotMine("a race without an end")) };
        let outcomes: Vec<String> = all.into_iter().map(|end| end.outcome).collect();
        let place = |region| regions.iter().position(|other| *other == region).unwrap_or_default();
        self.ends(regions, |region| &outcomes[place(region)]);
        let said = match enough {
            Some(true) => Some(SUCCESS.to_owned()),
            Some(false) => Some(ABORTED.to_owned()),
            None => decide.is_empty().then(|| outcomes[first].clone()),
        };
        self.decided(decide, variables, &outcomes, said)
    }

    fn ends<'o>(&mut self, regions: &[StateId], outcome: impl Fn(StateId) -> &'o str) {
        self.regions.extend(regions.iter().map(|region| (*region, outcome(*region).to_owned())));
    }

    /// Evaluates a region within these races.
    fn region(
        &mut self,
        region: StateId,
        path: &str,
        variables: &mut Variables,
        in_routine: bool,
        within: &Races,
    ) -> Result<Region, Fail> {
        (self.races, self.is_leaving) = (within.clone(), false);
        let name = &self.program.state(region).name;
        let outcome = match self.visit(region, &format!("{path}/{name}"), variables, in_routine) {
            Err(Fail::Cut) => Ok(if self.races.has_failed { ABORTED } else { PREEMPTED }.to_owned()),
            ended => ended,
        }?;
        let cut = self.is_leaving.then_some(self.races.cut);
        let (end_s, late_s) = (self.races.now_s, self.races.late_s);
        Ok(Region { outcome, end_s, late_s, cut, has_failed: self.races.has_failed })
    }

    /// Ends a race after all its regions.
    fn after(&mut self, outer: Races, is_leaving: bool, regions: &[Region]) -> Result<(), Fail> {
        let end_s = regions.iter().fold(outer.now_s, |latest, region| latest.max(region.end_s));
        let number = outer.watches.len();
        let is_inner = |region: &Region| region.cut.flatten().is_some_and(|cut| cut.race == number);
        let is_outer = |region: &Region| region.cut.is_some() && !is_inner(region);
        let late_s = regions.iter().fold(outer.late_s, |most, region| most.max(region.late_s));
        (self.races, self.is_leaving) = (Races { now_s: end_s, late_s, ..outer }, is_leaving);
        if regions.iter().any(is_outer) {
            self.races.has_failed |= regions.iter().any(|region| region.cut.is_some() && region.has_failed);
            return Ok(());
        }
        if regions.len() == 1 && !regions.iter().any(is_inner) {
            return Ok(());
        }
        // A race around may be decided, or a watch broken, during the way out.
        let is_late = !is_leaving && self.races.until.is_some_and(|(until_s, _)| end_s + late_s + CLOSE_S > until_s);
        if is_late || self.is_broken() {
            return Err(Fail::NotMine("a race that is cut short on its way out"));
        }
        Ok(())
    }

    /// Whether a region writes what another one reads or writes, or uses a kind of resource that another one uses: under the single lease of
    /// the race they might have to take turns.
    fn touch(&self, regions: &[StateId]) -> bool {
        let touched: Vec<Touched> = regions.iter().map(|region| self.touched(*region)).collect();
        touched.iter().enumerate().any(|(place, one)| {
            let others = touched.iter().enumerate().filter(|(other, _)| *other != place);
            others.map(|(_, other)| other).any(|other| {
                let meets = one.works_with.iter().any(|kind| other.works_with.contains(kind))
                    || one.writes.iter().any(|fact| other.reads.contains(fact) || other.writes.contains(fact));
                let writes = !one.writes.is_empty() || one.writes_any;
                meets || one.writes_any || other.reads_any && writes
            })
        })
    }

    /// Whether two of these regions of one node block the same kind: the node holds only the maximum of what its regions block.
    fn take_turns(&self, regions: &[StateId]) -> bool {
        let touched: Vec<Touched> = regions.iter().map(|region| self.touched(*region)).collect();
        let mut pairs =
            touched.iter().enumerate().flat_map(|(place, one)| touched[..place].iter().map(move |other| (one, other)));
        pairs.any(|(one, other)| one.works_with.iter().any(|kind| other.works_with.contains(kind)))
    }

    fn touched(&self, region: StateId) -> Touched {
        let mut touched = Touched::default();
        let mut open = vec![region];
        while let Some(id) = open.pop() {
            let state = self.program.state(id);
            open.extend(state.children());
            state.each_expression(&mut |_, expression: &Expr| {
                touched.reads.extend(expression.fact_expressions().into_iter().map(|fact| fact.predicate.clone()));
            });
            let annotations = &state.annotations;
            annotations.effects.values().for_each(|effects| written(effects, &mut touched.writes));
            let blocks = annotations.resources.iter().filter(|line| line.operation == ResourceOperation::Block);
            touched.works_with.extend(blocks.filter(|line| line.kind != WORLD_MODEL).map(|line| line.kind.clone()));
            let StateKind::Action { .. } = state.kind else { continue };
            match (&annotations.nature, &annotations.reads) {
                (Nature::Senses(facts), _) | (_, Some(facts)) => {
                    touched.reads.extend(facts.iter().map(|fact| fact.predicate.clone()));
                }
                (_, None) => touched.reads_any |= !state.is_pause(),
            }
            // Measured facts are not declared anywhere.
            let mut outcomes = state.outcomes.iter().map(String::as_str).chain([SUCCESS]);
            let is_said = |outcome: &str| annotations.effects.contains_key(outcome);
            touched.writes_any |= annotations.nature != Nature::Computes && !outcomes.all(is_said);
        }
        touched
    }
}

/// The facts and resources that a region uses.
#[derive(Default)]
struct Touched {
    reads: BTreeSet<String>,
    writes: BTreeSet<String>,
    works_with: BTreeSet<String>,
    reads_any: bool,
    writes_any: bool,
}

fn written(effects: &[EffectExpr], predicates: &mut BTreeSet<String>) {
    for effect in effects {
        match effect {
            EffectExpr::Set(fact, _) | EffectExpr::Delete(fact) | EffectExpr::Increase(fact, _) => {
                predicates.insert(fact.predicate.clone());
            }
            EffectExpr::ForEach { effects, .. } => written(effects, predicates),
        }
    }
}

/// The races inside of a new one; on the way out, the outer ones have no effect any more.
fn within(outer: &Races, is_leaving: bool, until: Option<(f64, usize)>, watch: Option<Watch>) -> Races {
    let mut watches = if is_leaving { vec![None; outer.watches.len()] } else { outer.watches.clone() };
    watches.push(watch);
    let around = outer.until.filter(|_| !is_leaving);
    let until = match (until, around) {
        (Some(own), Some(around)) if around.0 < own.0 => Some(around),
        (own, around) => own.or(around),
    };
    Races { now_s: outer.now_s, late_s: outer.late_s, until, watches, cut: None, has_failed: false }
}

/// Takes over a region's assignments to outer variables.
pub(super) fn merge(variables: &mut Variables, before: &Variables, own: Variables) {
    for (number, variable) in own.into_iter().enumerate().take(before.len()) {
        if variable.1 != before[number].1 {
            variables[number] = variable;
        }
    }
}
