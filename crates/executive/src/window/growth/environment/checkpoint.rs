//! The serialized environments of a window. Neighbouring environments share nearly everything, and so do their forms: frames,
//! variables, lists of loops and nodes of tables are written once.
//!
//! For a producer, sharing is more than a saving: its outputs are set once for all who refer to it, so it must be restored as one
//! value.

use super::{Binding, Environment, Frame, Iteration, Link, Producer, Variables};
use crate::binding::Outputs;
use crate::checkpoint::{Broken, Pool, at};
use crate::plan::Plan;
use crate::window::growth::table::{NodeForm, Nodes, Table};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::list::List;
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::sync::{Arc, OnceLock};

/// All environments of a window and the producers beside them, each in the order in which the window visits them.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Places<'a> {
    shared: Shared<'a>,
    environments: Vec<EnvironmentForm>,
    producers: Vec<u32>,
}

#[derive(Debug, Serialize, Deserialize)]
struct Shared<'a> {
    producers: Vec<ProducerForm<'a>>,
    lists: Vec<Cow<'a, List>>,
    frames: Vec<FrameForm>,
    variables: Vec<Vec<(Arc<str>, BindingForm<'a>)>>,
    writer_nodes: Vec<NodeForm<Link>>,
    producer_nodes: Vec<NodeForm<u32>>,
}

#[derive(Debug, Serialize, Deserialize)]
struct ProducerForm<'a> {
    instance: InstanceId,
    real: Option<Cow<'a, Outputs>>,
}

#[derive(Debug, Serialize, Deserialize)]
struct EnvironmentForm {
    frames: Option<u32>,
    variables: u32,
    writers: Option<u32>,
    test: Option<(StateId, IterationForm)>,
    producers: Option<u32>,
}

#[derive(Debug, Serialize, Deserialize)]
struct FrameForm {
    below: Option<u32>,
    owner: StateId,
    visit: u32,
    path: Arc<str>,
    visits: Vec<(StateId, u32)>,
    iteration: Option<IterationForm>,
    variables: usize,
    fork: Option<InstanceId>,
    earlier: Vec<StateId>,
}

#[derive(Debug, Serialize, Deserialize)]
struct IterationForm {
    index: usize,
    elements: Option<u32>,
}

#[derive(Debug, Serialize, Deserialize)]
enum BindingForm<'a> {
    Known(Cow<'a, Value>),
    Assigned(u32),
}

/// Collects the shared parts of a window.
#[derive(Default)]
pub(crate) struct Collector<'a> {
    known: Known<'a>,
    variables: Pool<Vec<(Arc<str>, BindingForm<'a>)>>,
    writer_nodes: Pool<NodeForm<Link>>,
    producer_nodes: Pool<NodeForm<u32>>,
    environments: Vec<EnvironmentForm>,
    named: Vec<u32>,
}

#[derive(Default)]
struct Known<'a> {
    producers: Pool<ProducerForm<'a>>,
    lists: Pool<Cow<'a, List>>,
    frames: Pool<FrameForm>,
}

impl<'a> Collector<'a> {
    pub(crate) fn add(&mut self, environment: &'a Environment) {
        let Environment { frames, variables, writers, test, producers } = environment;
        let form = EnvironmentForm {
            frames: frames.as_ref().map(|frame| self.known.frame(frame)),
            variables: self.variables(variables),
            writers: writers.form(&mut self.writer_nodes, &mut |link| *link),
            test: test.as_deref().map(|(state, iteration)| (*state, self.known.iteration(iteration))),
            producers: producers.form(&mut self.producer_nodes, &mut |producer| self.known.producer(producer)),
        };
        self.environments.push(form);
    }

    pub(crate) fn add_producer(&mut self, producer: &'a Arc<Producer>) {
        let place = self.known.producer(producer);
        self.named.push(place);
    }

    pub(crate) fn finish(self) -> Places<'a> {
        let shared = Shared {
            producers: self.known.producers.into_forms(),
            lists: self.known.lists.into_forms(),
            frames: self.known.frames.into_forms(),
            variables: self.variables.into_forms(),
            writer_nodes: self.writer_nodes.into_forms(),
            producer_nodes: self.producer_nodes.into_forms(),
        };
        Places { shared, environments: self.environments, producers: self.named }
    }

    fn variables(&mut self, variables: &'a Variables) -> u32 {
        if let Some(place) = self.variables.find(&variables.0) {
            return place;
        }
        let binding = |(name, binding): &'a (Arc<str>, Binding)| {
            let form = match binding {
                Binding::Known(value) => BindingForm::Known(Cow::Borrowed(value)),
                Binding::Assigned(producer) => BindingForm::Assigned(self.known.producer(producer)),
            };
            (name.clone(), form)
        };
        let form = variables.0.iter().map(binding).collect();
        self.variables.add(&variables.0, form)
    }
}

impl<'a> Known<'a> {
    fn producer(&mut self, producer: &'a Arc<Producer>) -> u32 {
        if let Some(place) = self.producers.find(producer) {
            return place;
        }
        let form = ProducerForm { instance: producer.instance, real: producer.outputs().map(Cow::Borrowed) };
        self.producers.add(producer, form)
    }

    fn iteration(&mut self, iteration: &'a Iteration) -> IterationForm {
        let elements = iteration.elements.as_ref().map(|elements| {
            let known = self.lists.find(elements);
            known.unwrap_or_else(|| self.lists.add(elements, Cow::Borrowed(elements)))
        });
        IterationForm { index: iteration.index, elements }
    }

    fn frame(&mut self, frame: &'a Arc<Frame>) -> u32 {
        // From the innermost new frame outwards, then back: a frame is written after the frame below it.
        let mut new = Vec::new();
        let mut at = Some(frame);
        while let Some(frame) = at.filter(|frame| self.frames.find(frame).is_none()) {
            new.push(frame);
            at = frame.below.as_ref();
        }
        for frame in new.into_iter().rev() {
            let Frame { below, owner, visit, path, visits, iteration, variables, fork, earlier } = &**frame;
            let form = FrameForm {
                below: below.as_ref().and_then(|below| self.frames.find(below)),
                owner: *owner,
                visit: *visit,
                path: path.clone(),
                visits: visits.clone(),
                iteration: iteration.as_ref().map(|iteration| self.iteration(iteration)),
                variables: *variables,
                fork: *fork,
                earlier: earlier.clone(),
            };
            self.frames.add(frame, form);
        }
        self.frames.find(frame).unwrap_or(u32::MAX)
    }
}

/// Restored parts, returned in the order in which they were collected.
pub(crate) struct Restored {
    environments: std::vec::IntoIter<Environment>,
    producers: std::vec::IntoIter<Arc<Producer>>,
}

impl Restored {
    pub(crate) fn environment(&mut self) -> Result<Environment, Broken> {
        self.environments.next().ok_or("fewer environments than places")
    }

    pub(crate) fn producer(&mut self) -> Result<Arc<Producer>, Broken> {
        self.producers.next().ok_or("fewer producers than places")
    }

    /// Checks that all parts were used.
    pub(crate) fn finish(self) -> Result<(), Broken> {
        let is_over = self.environments.as_slice().is_empty() && self.producers.as_slice().is_empty();
        if is_over { Ok(()) } else { Err("more environments than places") }
    }
}

impl Places<'_> {
    /// The environments and producers.
    pub(crate) fn restored(self, plan: &Plan) -> Result<Restored, Broken> {
        let Shared { producers, lists, frames, variables, writer_nodes, producer_nodes } = self.shared;
        let producer = |ProducerForm { instance, real }| {
            let real = real.map_or_else(OnceLock::new, |real| OnceLock::from(real.into_owned()));
            Arc::new(Producer { real, ..Producer::new(instance) })
        };
        let producers: Vec<Arc<Producer>> = producers.into_iter().map(producer).collect();
        let producer = |place: u32| at(&producers, place, "a producer that is not there");
        let lists: Vec<Arc<List>> = lists.into_iter().map(|list| Arc::new(list.into_owned())).collect();
        let iteration = |IterationForm { index, elements }| {
            let elements = elements.map(|place| at(&lists, place, "a list of a loop that is not there")).transpose()?;
            Ok::<_, Broken>(Iteration { index, elements })
        };
        let mut all_frames: Vec<Arc<Frame>> = Vec::with_capacity(frames.len());
        for form in frames {
            let FrameForm { below, owner, visit, path, visits, iteration: of, variables, fork, earlier } = form;
            let below = below.map(|place| at(&all_frames, place, "a frame that stands before its own")).transpose()?;
            let iteration = of.map(iteration).transpose()?;
            all_frames.push(Arc::new(Frame { below, owner, visit, path, visits, iteration, variables, fork, earlier }));
        }
        let binding = |(name, form)| {
            let binding = match form {
                BindingForm::Known(value) => Binding::Known(value.into_owned()),
                BindingForm::Assigned(place) => Binding::Assigned(producer(place)?),
            };
            Ok((name, binding))
        };
        let all = |form: Vec<_>| form.into_iter().map(binding).collect::<Result<Vec<_>, Broken>>();
        let variables = variables.into_iter().map(|form| Ok(Variables(Arc::new(all(form)?))));
        let variables = variables.collect::<Result<Vec<_>, Broken>>()?;
        let writer_nodes = Nodes::of_forms(writer_nodes, Ok)?;
        let producer_nodes = Nodes::of_forms(producer_nodes, producer)?;
        let empty = Environment::new(plan);
        let environment = |form: EnvironmentForm| {
            let frames = form.frames.map(|place| at(&all_frames, place, "a frame that is not there")).transpose()?;
            let test =
                form.test.map(|(state, form)| Ok::<_, Broken>(Box::new((state, iteration(form)?)))).transpose()?;
            Ok(Environment {
                frames,
                variables: at(&variables, form.variables, "variables that are not there")?,
                writers: Table::of_form(empty.writers.clone(), form.writers, &writer_nodes)?,
                test,
                producers: Table::of_form(empty.producers.clone(), form.producers, &producer_nodes)?,
            })
        };
        let environments = self.environments.into_iter().map(environment).collect::<Result<Vec<_>, Broken>>()?;
        let named = self.producers.into_iter().map(producer).collect::<Result<Vec<_>, Broken>>()?;
        Ok(Restored { environments: environments.into_iter(), producers: named.into_iter() })
    }
}
