//! Straight lines by way of other postures of the same poses, for redundant arms (with more joints than a pose needs).
//!
//! ```text
//! rung 0   start ─── its elbow turned ── …
//!            │    ╲      │
//! rung 1   posture ── posture ── posture …      the same pose, the elbow at several turns
//!            │           │    ╱
//! rung n   posture ── posture …                 any of these ends the line
//! ```
//!
//! The ladder graph of Descartes (Edwards, Lewis, De Gregorio, Meyer: *Descartes, a path-planning library for semi-constrained Cartesian trajectories*,
//! 2015): a rung for every few centimetres of the line, with postures from the whole redundancy, and steps between postures that are close to each
//! other, on one rung (the tool stands while the elbow turns) or to the next (both at once). The fastest way up is searched; its steps are checked
//! finely only then, and failing steps are excluded from the next search. The way is smoothed afterwards, so that the arm does not stop at each rung.
//! Everything is bounded and deterministic. No other start posture is tried.

use crate::joint_vector::JointVector;
use crate::line::{self, Cause, FINEST, Lines, MAX_JUMP, MAX_STEPS, STRAY_M, Traced};
use crate::pace::{Control, Stop};
use crate::reach::Reach;
use ratn_model::pose::Pose;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

/// Maximum number of line steps per rung (2 cm, or 5 degrees).
const STEPS_PER_RUNG: usize = 8;

/// Maximum number of rungs: 8 m.
const MAX_RUNGS: usize = 400;

/// Maximum number of postures on a ladder.
const MAX_POSTURES: usize = 60_000;

/// Maximum joint motion in a step between postures of the ladder, in radians or metres.
const MAX_STEP: f64 = 0.6;

/// Maximum number of further searches after a step has failed.
const REPAIRS: usize = 48;

/// Maximum number of expanded postures, in all searches for one line together.
const MAX_VISITS: usize = 100_000;

/// Numbers of smoothing passes that are tried, in this order.
const EVENINGS: [usize; 4] = [60, 12, 3, 0];

/// Maximum joint motion, over all joints, from one fine posture to the next. The tool deviates in rotation from the line by at most an eighth of its
/// square, half a milliradian.
const MOST_TURNS_RAD: f64 = 0.063;

/// Costs of the search are integers, in units of this time in seconds.
const TICK_S: f64 = 1e-5;

/// A rung of the ladder, with the part of a piece that leads to it.
#[derive(Debug, Clone, Copy)]
struct Rung {
    piece: usize,
    from: f64,
    to: f64,
}

/// A posture by its rung (0: the start of the line) and its index there.
type Node = (usize, usize);

struct Ladder<'l> {
    reach: &'l Reach,
    lines: &'l Lines,
    rungs: Vec<Rung>,
    /// Postures by rung, as far as they were needed.
    postures: Vec<Vec<JointVector>>,
    count: usize,
    visits: usize,
    /// Whether the postures that were checked are free.
    free: BTreeMap<Node, bool>,
    failed: BTreeSet<(Node, Node)>,
    followed: BTreeSet<(Node, Node)>,
}

/// A path along lines from `start`, whose joints move straight between its postures where `is_free` allows it; `None` where none is found.
///
/// # Errors
/// What `control` returned, where that ends the search.
pub(crate) fn climb(
    reach: &Reach,
    lines: &Lines,
    start: &JointVector,
    is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
    control: &mut dyn FnMut() -> Control,
) -> Result<Option<Traced>, Stop> {
    if !reach.has_families() || lines.is_too_long() {
        return Ok(None);
    }
    let rungs = rungs(lines);
    if rungs.len() > MAX_RUNGS {
        return Ok(None);
    }
    let Some(first) = rungs.first() else { return Ok(None) };
    let pose = lines.pieces[first.piece].at(first.from);
    let mut postures = reach.family(&reach.target(pose), start);
    postures.insert(0, *start);
    let count = postures.len();
    let (failed, followed) = (BTreeSet::new(), BTreeSet::new());
    let mut ladder = Ladder {
        reach,
        lines,
        rungs,
        postures: vec![postures],
        count,
        visits: 0,
        free: BTreeMap::new(),
        failed,
        followed,
    };
    for _ in 0..REPAIRS {
        let Some(way) = ladder.quickest(is_free, control)? else { return Ok(None) };
        if ladder.test(&way, is_free, control)? {
            return ladder.even(&way, is_free, control);
        }
    }
    Ok(None)
}

fn rungs(lines: &Lines) -> Vec<Rung> {
    let mut rungs = Vec::new();
    for (piece, line) in lines.pieces.iter().enumerate() {
        let parts = line.steps().div_ceil(STEPS_PER_RUNG);
        let share = |i: usize| i as f64 / parts as f64;
        rungs.extend((0..parts).map(|i| Rung { piece, from: share(i), to: share(i + 1) }));
    }
    rungs
}

impl Ladder<'_> {
    /// The fastest way from the start to the last rung, without steps that have failed.
    fn quickest(
        &mut self,
        is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
        control: &mut dyn FnMut() -> Control,
    ) -> Result<Option<Vec<Node>>, Stop> {
        let start: Node = (0, 0);
        let mut costs: Vec<Vec<u64>> = Vec::new();
        let mut before: Vec<Vec<Node>> = Vec::new();
        let mut queue = BinaryHeap::from([Reverse((0, start))]);
        self.grow(&mut costs, &mut before, start);
        costs[0][0] = 0;
        while let Some(Reverse((cost, node))) = queue.pop() {
            if cost > costs[node.0][node.1] {
                continue;
            }
            let answer = control();
            if !answer.goes_on() {
                return Err(answer.into());
            }
            let here = self.postures[node.0][node.1];
            if !*self.free.entry(node).or_insert_with(|| node == start || is_free(&here, &here)) {
                continue;
            }
            if node.0 == self.rungs.len() {
                let mut way = vec![node];
                while way[way.len() - 1] != start {
                    let last = way[way.len() - 1];
                    way.push(before[last.0][last.1]);
                }
                way.reverse();
                return Ok(Some(way));
            }
            let above = (node.0 + 1, 0);
            self.visits += 1;
            if self.visits > MAX_VISITS || !self.make(above.0) {
                return Ok(None);
            }
            self.grow(&mut costs, &mut before, above);
            for rung in [node.0, above.0] {
                for (place, posture) in self.postures[rung].iter().enumerate() {
                    let next = (rung, place);
                    let Some(lasts) = self.lasts(&here, posture) else { continue };
                    let cost = cost + lasts;
                    if cost < costs[rung][place] && !self.failed.contains(&(node, next)) {
                        costs[rung][place] = cost;
                        before[rung][place] = node;
                        queue.push(Reverse((cost, next)));
                    }
                }
            }
        }
        Ok(None)
    }

    /// Makes room for the search data of the nodes up to a rung.
    fn grow(&self, costs: &mut Vec<Vec<u64>>, before: &mut Vec<Vec<Node>>, to: Node) {
        for rung in costs.len()..=to.0 {
            costs.push(vec![u64::MAX; self.postures[rung].len()]);
            before.push(vec![(0, 0); self.postures[rung].len()]);
        }
    }

    /// Computes the postures of a rung; returns whether the total is within the limit.
    fn make(&mut self, rung: usize) -> bool {
        if rung == self.postures.len() {
            let Rung { piece, to, .. } = self.rungs[rung - 1];
            let target = self.reach.target(self.lines.pieces[piece].at(to));
            let postures = self.reach.family(&target, &self.postures[0][0]);
            self.count += postures.len();
            self.postures.push(postures);
        }
        self.count <= MAX_POSTURES
    }

    /// Cost of a step between two postures, in ticks at the joints' full speeds; `None` where a joint moves too far for a step.
    fn lasts(&self, from: &JointVector, to: &JointVector) -> Option<u64> {
        let mut square = 0.0;
        for (j, joint) in self.reach.limits().iter().enumerate() {
            let by = (to[j] - from[j]).abs();
            if by > MAX_STEP {
                return None;
            }
            square += (by / joint.velocity).powi(2);
        }
        Some((square.sqrt() / TICK_S).ceil() as u64 + 1)
    }

    /// Checks the steps of a way that were not checked yet; returns whether all succeed. A failing step is not used again.
    fn test(
        &mut self,
        way: &[Node],
        is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
        control: &mut dyn FnMut() -> Control,
    ) -> Result<bool, Stop> {
        for pair in way.windows(2) {
            let step = (pair[0], pair[1]);
            if self.followed.contains(&step) {
                continue;
            }
            let [from, to] = [step.0, step.1].map(|(rung, place)| self.postures[rung][place]);
            match self.follow(&Step::straight([step.0.0, step.1.0], [from, to]), is_free, control)? {
                Some(_) => self.followed.insert(step),
                None => {
                    self.failed.insert(step);
                    return Ok(false);
                }
            };
        }
        Ok(true)
    }

    /// The way with its postures smoothed as far as it can still be followed, in fine steps.
    fn even(
        &self,
        way: &[Node],
        is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
        control: &mut dyn FnMut() -> Control,
    ) -> Result<Option<Traced>, Stop> {
        let rough: Vec<JointVector> = way.iter().map(|(rung, place)| self.postures[*rung][*place]).collect();
        for sweeps in EVENINGS {
            let mut postures = rough.clone();
            for _ in 0..sweeps {
                for k in 1..way.len() - 1 {
                    let [before, here, after] = [postures[k - 1], postures[k], postures[k + 1]];
                    let mean = JointVector::from_fn(here.len(), |j| (before[j] + 2.0 * here[j] + after[j]) / 4.0);
                    let target = self.reach.target(self.pose(way[k].0));
                    postures[k] = self.reach.descend(&target, &mean).unwrap_or(here);
                }
            }
            let tangents = (sweeps > 0).then(|| tangents(&postures));
            if let Some(traced) = self.traced(way, &postures, tangents.as_deref(), is_free, control)? {
                return Ok(Some(traced));
            }
        }
        Ok(None)
    }

    /// Fine postures along a way whose rungs have the given postures.
    fn traced(
        &self,
        way: &[Node],
        postures: &[JointVector],
        tangents: Option<&[JointVector]>,
        is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
        control: &mut dyn FnMut() -> Control,
    ) -> Result<Option<Traced>, Stop> {
        let mut traced = Traced::beginning(self.lines, &postures[0]);
        for (k, pair) in postures.windows(2).enumerate() {
            let mut step = Step::straight([way[k].0, way[k + 1].0], [pair[0], pair[1]]);
            if let Some(tangents) = tangents {
                step.tangents = [tangents[k], tangents[k + 1]];
            }
            let Some(fine) = self.follow(&step, is_free, control)? else { return Ok(None) };
            for Fine { posture, piece, share } in fine {
                traced.whither = self.lines.pieces[piece].towards;
                traced.push(posture, self.lines, piece, share);
            }
            if traced.postures.len() > MAX_STEPS {
                return Ok(None);
            }
        }
        Ok(Some(traced))
    }

    /// One step of a way in fine steps: the tool on the line, the joints as close as possible to a cubic between the ends.
    fn follow(
        &self,
        step: &Step,
        is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
        control: &mut dyn FnMut() -> Control,
    ) -> Result<Option<Vec<Fine>>, Stop> {
        let [first, last] = step.rungs;
        let (piece, [from, to]) = if first == last {
            let (piece, share) = self.place(last);
            (piece, [share; 2])
        } else {
            let Rung { piece, from, to } = self.rungs[last - 1];
            (piece, [from, to])
        };
        let by = JointVector::from_fn(step.ends[0].len(), |j| (step.ends[1][j] - step.ends[0][j]).abs());
        let furthest = by.iter().fold(0.0_f64, |most, by| most.max(*by));
        let levers = self.reach.levers();
        let bent = (levers.bend_m(&by) / STRAY_M).sqrt().max(levers.turns_rad(&by) / MOST_TURNS_RAD);
        let least = if first == last { 1.0 } else { STEPS_PER_RUNG as f64 };
        let steps = (2.0 * (furthest / MAX_JUMP).max(bent)).ceil().max(least);
        let (mut here, mut done, mut part) = (step.ends[0], 0.0, 1.0 / steps);
        let turns_rad = |from: &JointVector, to: &JointVector| {
            levers.turns_rad(&JointVector::from_fn(from.len(), |j| (to[j] - from[j]).abs()))
        };
        let mut fine = Vec::new();
        while done < 1.0 {
            let answer = control();
            if !answer.goes_on() {
                return Err(answer.into());
            }
            let share = if done + part > 1.0 - 1e-9 { 1.0 } else { done + part };
            let on_line = from + share * (to - from);
            let seed = if share == 1.0 { step.ends[1] } else { step.at(share) };
            match line::step(self.reach, &here, &seed, &self.lines.pieces[piece].at(on_line)) {
                Ok(next) if turns_rad(&here, &next) > MOST_TURNS_RAD && part * steps > FINEST => part /= 2.0,
                Ok(next) if turns_rad(&here, &next) <= MOST_TURNS_RAD && is_free(&here, &next) => {
                    fine.push(Fine { posture: next, piece, share: on_line });
                    (here, done) = (next, share);
                }
                Err(Cause::Flip { .. }) if part * steps > FINEST => part /= 2.0,
                _ => return Ok(None),
            }
        }
        Ok(Some(fine))
    }

    /// The pose of a rung.
    fn pose(&self, rung: usize) -> Pose {
        let (piece, share) = self.place(rung);
        self.lines.pieces[piece].at(share)
    }

    /// The piece of a rung, and the share of it.
    fn place(&self, rung: usize) -> (usize, f64) {
        match rung.checked_sub(1) {
            None => (self.rungs[0].piece, self.rungs[0].from),
            Some(before) => (self.rungs[before].piece, self.rungs[before].to),
        }
    }
}

/// A step from one posture to another, on one rung or to the next.
struct Step {
    rungs: [usize; 2],
    ends: [JointVector; 2],
    /// Derivatives of the joints at the ends, per step.
    tangents: [JointVector; 2],
}

/// A posture on the line.
struct Fine {
    posture: JointVector,
    piece: usize,
    share: f64,
}

impl Step {
    /// A cubic Hermite polynomial.
    fn at(&self, share: f64) -> JointVector {
        let [(a, b), (u, v)] = [(&self.ends[0], &self.ends[1]), (&self.tangents[0], &self.tangents[1])];
        let (s, t) = (share, 1.0 - share);
        JointVector::from_fn(a.len(), |j| {
            t * t * (1.0 + 2.0 * s) * a[j] + s * s * (1.0 + 2.0 * t) * b[j] + s * t * (t * u[j] - s * v[j])
        })
    }

    /// The joints move linearly.
    fn straight(rungs: [usize; 2], ends: [JointVector; 2]) -> Step {
        let way = JointVector::from_fn(ends[0].len(), |j| ends[1][j] - ends[0][j]);
        Step { rungs, ends, tangents: [way; 2] }
    }
}

/// Half the difference between the postures before and after each; at the ends the difference to the neighbour.
fn tangents(postures: &[JointVector]) -> Vec<JointVector> {
    let last = postures.len() - 1;
    let tangent = |k: usize| {
        let (before, after) = (k.saturating_sub(1), (k + 1).min(last));
        let steps = (after - before).max(1) as f64;
        JointVector::from_fn(postures[k].len(), |j| (postures[after][j] - postures[before][j]) / steps)
    };
    (0..=last).map(tangent).collect()
}
