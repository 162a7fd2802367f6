//! Loops: appends iterations one behind the other, as far as the list is known or a test is decided or predicted.

use super::Growth;
use super::append::What;
use super::cursor::Todo;
use super::environment::Iteration;
use crate::context::Context;
use crate::window::graph::Graph;
use crate::window::graph::instance::Role;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::list::List;
use ratn_model::program::{Program, StateKind};
use std::sync::Arc;

impl Growth {
    /// The list of a loop is known: begins its iterations.
    pub(crate) fn unroll(&mut self, graph: &Graph, context: &Context<'_>, waits_for: InstanceId, elements: List) {
        let Some(index) = self.cursors.iter().position(|cursor| cursor.todo == Todo::Await(waits_for)) else { return };
        let Some(instance) = graph.get(waits_for) else { return };
        let (state, visit) = (context.program.state(instance.state), instance.visit);
        let path: Arc<str> = self.cursors[index].environment.path(&state.name, visit, None).into();
        let base = self.cursors[index].environment.variables.len();
        let iteration = Iteration { index: usize::MAX, elements: Some(Arc::new(elements)) };
        let frame = self.frame(index, state.id, visit, path, base, Some(iteration));
        let cursor = &mut self.cursors[index];
        cursor.environment.frames = Some(frame);
        cursor.todo = Todo::Iterate;
    }

    /// Goes on to the next iteration of the innermost loop, or to its end.
    pub(super) fn iterate(&mut self, graph: &mut Graph, context: &mut Context<'_>, index: usize) {
        let program = context.program;
        let Some(frame) = self.top_frame(index) else { return };
        let (owner, visit, base) = (frame.owner, frame.visit, frame.variables);
        let Some(iteration) = &mut frame.iteration else { return };
        iteration.index = iteration.index.wrapping_add(1);
        let number = iteration.index;
        let ends = iteration.elements.as_ref().map(|elements| number >= elements.len());
        frame.visits.clear();
        match ends {
            Some(false) => self.begin_iteration(index, program),
            Some(true) => self.leave_frame(index, 0),
            None => {
                let state = program.state(owner);
                // The test has the place of the loop, not a place in its body.
                let environment = &mut self.cursors[index].environment;
                environment.variables.truncate(base);
                let inside = environment.frames.clone();
                environment.frames = inside.as_ref().and_then(|frame| frame.below.clone());
                environment.test = Some(Box::new((owner, Iteration { index: number, elements: None })));
                let test = self.append(graph, context, index, state, What::marker(Role::Test), (visit, Some(number)));
                self.cursors[index].environment.test = None;
                self.branch_on_test(graph, context, index, test, visit, number);
            }
        }
    }

    /// Continues with the first state of the innermost loop's body.
    pub(super) fn begin_iteration(&mut self, index: usize, program: &Program) {
        let Some(frame) = &self.cursors[index].environment.frames else { return };
        let body = match &program.state(frame.owner).kind {
            StateKind::ForEach { body, .. } | StateKind::While { body, .. } => body.first(),
            _ => None,
        };
        let (owner, base) = (frame.owner, frame.variables);
        self.cursors[index].count_visit();
        self.cursors[index].environment.variables.truncate(base);
        self.cursors[index].todo = body.map_or(Todo::Iterate, |first| Todo::Enter(*first));
        self.note_earlier(index, program.list_of(owner));
    }

    /// An iteration begins: notes that the outputs of the body's states are those of the iteration before.
    pub(super) fn note_earlier(&mut self, index: usize, body: &[StateId]) {
        let environment = &self.cursors[index].environment;
        let earlier: Vec<StateId> = body.iter().copied().filter(|id| environment.producer(*id).is_some()).collect();
        if earlier.is_empty() && environment.frames.as_ref().is_none_or(|frame| frame.earlier.is_empty()) {
            return;
        }
        if let Some(frame) = self.top_frame(index) {
            frame.earlier = earlier;
        }
    }

    /// Removes old outputs of body states that this iteration has passed over on its way to `to`, or to its end. Outputs of states that may still
    /// come stay those of the iteration before.
    pub(super) fn forget_passed_over(&mut self, program: &Program, index: usize, to: Option<StateId>) {
        let Some(frame) = self.cursors[index].environment.frames.as_ref() else { return };
        if frame.earlier.is_empty() {
            return;
        }
        let body = program.list_of(frame.owner);
        let end = to.and_then(|to| body.iter().position(|id| *id == to)).unwrap_or(body.len());
        let Some(frame) = self.top_frame(index) else { return };
        let earlier = std::mem::take(&mut frame.earlier);
        let (passed, later): (Vec<_>, Vec<_>) = earlier.into_iter().partition(|id| body[..end].contains(id));
        frame.earlier = later;
        for id in passed {
            self.cursors[index].environment.producers.set(id.0 as usize, None);
        }
    }

    /// A state has written its outputs in this iteration.
    pub(super) fn is_of_now(&mut self, index: usize, id: StateId) {
        let frames = self.cursors[index].environment.frames.as_ref();
        if frames.is_some_and(|frame| frame.earlier.contains(&id))
            && let Some(frame) = self.top_frame(index)
        {
            frame.earlier.retain(|earlier| *earlier != id);
        }
    }
}
