//! What is fixed about a place of the program when the window grows there: its place in the tree of states, its variables,
//! the last writer of each port (register renaming), and the older writers of each predicate (memory renaming). Copies
//! share their data.

mod checkpoint;

pub(crate) use checkpoint::{Collector, Places, Restored};

use super::table::Table;
use crate::binding::Outputs;
use crate::plan::{Chain, Outcome, Plan};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::list::List;
use ratn_model::program::{Program, StateKind};
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::sync::{Arc, OnceLock};

/// A place's environment.
#[derive(Debug, Clone, Default)]
pub(crate) struct Environment {
    pub(crate) frames: Option<Arc<Frame>>,
    pub(crate) variables: Variables,
    /// By chain, its youngest writer before this place.
    pub(crate) writers: Table<Link>,
    /// For the test of a `while`: the iteration that it decides on, which has not begun yet.
    pub(crate) test: Option<Box<(StateId, Iteration)>>,
    /// By state, the last writer of its outputs; at the number of states plus its own number, the outcome of a region.
    pub(crate) producers: Table<Arc<Producer>>,
}

/// A writer in a chain, seen along one of its arms. The writer's own environment links to the next older one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Link {
    pub(crate) writer: InstanceId,
    /// The outcome that the path assumes.
    pub(crate) outcome: Outcome,
    /// The outcomes of the arm have different effects.
    pub(crate) vague: bool,
}

/// The writer of outputs. Its outputs stay here after it has retired, as long as an expression can refer to them.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Producer {
    #[serde(skip)]
    pub(crate) instance: InstanceId,
    #[serde(skip)]
    pub(crate) real: OnceLock<Outputs>,
    /// Later improved outputs, once an instance that uses them begins.
    #[serde(skip)]
    pub(crate) better: OnceLock<Outputs>,
}

impl Producer {
    /// The producer for an instance that has not retired.
    pub(crate) fn new(instance: InstanceId) -> Producer {
        Producer { instance, real: OnceLock::new(), better: OnceLock::new() }
    }

    /// The outputs, once the instance has retired.
    pub(crate) fn outputs(&self) -> Option<&Outputs> {
        self.better.get().or_else(|| self.real.get())
    }
}

/// One activation of a list of states.
#[derive(Debug, Clone)]
pub(crate) struct Frame {
    pub(crate) below: Option<Arc<Frame>>,
    /// The state that owns the list, and its visit number.
    pub(crate) owner: StateId,
    pub(crate) visit: u32,
    /// Path of the owner, without the iteration.
    pub(crate) path: Arc<str>,
    /// Number of visits of each state that can be visited several times.
    pub(crate) visits: Vec<(StateId, u32)>,
    /// In a loop: its iteration.
    pub(crate) iteration: Option<Iteration>,
    /// Number of variables before the owner was entered.
    pub(crate) variables: usize,
    /// In a region: its fork.
    pub(crate) fork: Option<InstanceId>,
    /// In the body of a loop: the states whose outputs are still those of the iteration before.
    pub(crate) earlier: Vec<StateId>,
}

/// An iteration of a loop.
#[derive(Debug, Clone)]
pub(crate) struct Iteration {
    pub(crate) index: usize,
    /// The elements; `None` in a `while`.
    pub(crate) elements: Option<Arc<List>>,
}

/// The variables in scope, the innermost last. Copying is cheap.
#[derive(Debug, Clone, Default)]
pub(crate) struct Variables(Arc<Vec<(Arc<str>, Binding)>>);

/// The value or source of a variable.
#[derive(Debug, Clone)]
pub(crate) enum Binding {
    Known(Value),
    /// The value that an instance assigns: its output port [`assigned`].
    Assigned(Arc<Producer>),
}

/// First character of ports with assigned values; no declared port begins with it.
pub(crate) const ASSIGNED: char = '$';

/// The output port in which an instance keeps the value that it assigns to a variable.
pub(crate) fn assigned(variable: &str) -> String {
    format!("{ASSIGNED}{variable}")
}

impl Variables {
    pub(crate) fn len(&self) -> usize {
        self.0.len()
    }

    pub(crate) fn get(&self, name: &str) -> Option<&Binding> {
        self.0.iter().rev().find(|(n, _)| &**n == name).map(|(_, binding)| binding)
    }

    pub(crate) fn declare(&mut self, name: &str, binding: Binding) {
        Arc::make_mut(&mut self.0).push((Arc::from(name), binding));
    }

    /// Binds the innermost variable of a name anew.
    pub(crate) fn assign(&mut self, name: &str, binding: Binding) {
        if let Some(slot) = Arc::make_mut(&mut self.0).iter_mut().rev().find(|(n, _)| &**n == name) {
            slot.1 = binding;
        }
    }

    pub(crate) fn truncate(&mut self, len: usize) {
        if self.0.len() > len {
            Arc::make_mut(&mut self.0).truncate(len);
        }
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = &(Arc<str>, Binding)> {
        self.0.iter()
    }
}

impl Environment {
    pub(crate) fn new(plan: &Plan) -> Environment {
        Environment {
            frames: None,
            variables: Variables::default(),
            test: None,
            writers: Table::new(plan.chains()),
            producers: Table::new(2 * plan.len()),
        }
    }

    /// The loop variables in scope, innermost first: name and value.
    pub(crate) fn loop_variables<'a>(
        &'a self,
        program: &'a Program,
    ) -> impl Iterator<Item = (&'a str, Cow<'a, Value>)> + 'a {
        let frames = std::iter::successors(self.frames.as_deref(), |frame| frame.below.as_deref());
        let looping = self
            .test
            .iter()
            .map(|test| (test.0, &test.1))
            .chain(frames.filter_map(|frame| Some((frame.owner, frame.iteration.as_ref()?))));
        looping.flat_map(|(owner, iteration)| {
            let (variable, index) = match &program.state(owner).kind {
                StateKind::ForEach { variable, index, .. } => (Some(variable.as_str()), index.as_deref()),
                StateKind::While { index, .. } => (None, index.as_deref()),
                _ => (None, None),
            };
            let element = iteration.elements.as_ref().and_then(|all| all.get(iteration.index));
            let number = || Cow::Owned(Value::Int(i64::try_from(iteration.index).unwrap_or(i64::MAX)));
            let element = variable.zip(element.map(Cow::Borrowed));
            element.into_iter().chain(index.map(|name| (name, number())))
        })
    }

    pub(crate) fn producer(&self, state: StateId) -> Option<&Arc<Producer>> {
        self.producers.get(state.0 as usize)
    }

    pub(crate) fn writer(&self, chain: Chain) -> Option<Link> {
        self.writers.get(chain).copied()
    }

    /// The path of a state visited here.
    pub(crate) fn path(&self, name: &str, visit: u32, iteration: Option<usize>) -> String {
        let prefix = self.frames.as_ref().map_or(0, |frame| frame.path.len());
        let mut path = String::with_capacity(prefix + name.len() + 16);
        self.path_parts(name, visit, iteration, |part| path.push_str(part));
        path
    }

    /// The same path, part by part.
    pub(crate) fn path_parts(&self, name: &str, visit: u32, iteration: Option<usize>, mut part: impl FnMut(&str)) {
        let prefix = self.frames.as_ref().map_or("", |frame| &*frame.path);
        part(prefix);
        if let Some(iteration) = self.frames.as_ref().and_then(|frame| frame.iteration.as_ref()) {
            number("[", iteration.index, "]", &mut part);
        }
        if !prefix.is_empty() && !name.is_empty() {
            part("/");
        }
        part(name);
        if visit > 1 {
            number("#", visit as usize, "", &mut part);
        }
        if let Some(index) = iteration {
            number("[", index, "]", &mut part);
        }
    }
}

fn number(before: &str, number: usize, after: &str, part: &mut impl FnMut(&str)) {
    part(before);
    decimal(number, part);
    part(after);
}

/// The decimal digits of a number. The standard library's formatting takes several times as long, and every instance has a
/// path.
fn decimal(mut number: usize, part: &mut impl FnMut(&str)) {
    let mut digits = [b'0'; 20];
    let mut at = digits.len();
    loop {
        at -= 1;
        digits[at] += u8::try_from(number % 10).unwrap_or(0);
        number /= 10;
        if number == 0 {
            break;
        }
    }
    part(std::str::from_utf8(&digits[at..]).unwrap_or_default());
}

#[cfg(test)]
mod tests {
    use super::decimal;

    #[test]
    fn numbers_of_paths_are_written_in_full() {
        for number in [0, 7, 10, 90_909, usize::MAX] {
            let mut written = String::new();
            decimal(number, &mut |part: &str| written.push_str(part));
            assert_eq!(written, number.to_string());
        }
    }
}
