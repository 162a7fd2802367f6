//! The survey: one walk over the window in program order, along every branch, carrying what each place sees of the older
//! instances. What may begin begins; what can be decided is decided.

use crate::binding::{self, Outputs};
use crate::context::Context;
use crate::window::Window;
use crate::window::instance::{Ended, Role, Status};
use crate::window::place::Place;
use ratn_model::id::InstanceId;
use ratn_model::program::StateKind;

impl Window {
    /// Walks the window once; whether anything moved.
    pub(crate) fn survey(&mut self, context: &mut Context<'_>) -> bool {
        let Some(oldest) = self.oldest else { return false };
        let mut moved = false;
        let mut open = vec![(oldest, Place::root(context.root))];
        while let Some((id, mut place)) = open.pop() {
            // A decision may have squashed what was still to be visited.
            if !self.instances.alive.contains_key(&id) {
                continue;
            }
            moved |= self.visit(context, id, &place);
            if self.end.is_some() {
                return true;
            }
            self.settle_result(context, id, &place);
            place.pass(context.program, context.analysis, &self.instances, id);
            let next = self.instances.alive.get(&id).map(|i| i.next.clone()).unwrap_or_default();
            // The first branch is visited first.
            for younger in next.into_iter().rev() {
                open.push((younger, place.clone()));
            }
        }
        moved
    }

    fn visit(&mut self, context: &mut Context<'_>, id: InstanceId, place: &Place) -> bool {
        let Some(instance) = self.instances.alive.get(&id) else { return false };
        match (instance.role, instance.status) {
            (Role::Node, Status::Expanded) => {
                let readiness = self.readiness(context, id, place);
                self.begin_if(context, id, place, readiness)
            }
            (Role::Node, Status::Granted) => self.proceed(context, id, place),
            (Role::Condition | Role::Loop, Status::Expanded) => self.decide(context, id, place),
            (Role::Entry, Status::Expanded) if place.oldest => {
                let state = context.program.state(instance.state);
                let unmet = place.with_scope(&self.instances, id, None, |scope| binding::unmet(state, scope));
                let ended = match unmet {
                    Some(Ok(None)) | None => Ended::success(Outputs::new()),
                    Some(Ok(Some(reason))) => Ended::aborted(reason),
                    Some(Err(error)) => Ended::aborted(error.reason()),
                };
                self.end_instance(id, ended)
            }
            (Role::Exit, Status::Expanded) => self.leave_composite(context, id, place),
            (Role::End, Status::Expanded) if place.oldest => self.end_run(context, id, place),
            _ => false,
        }
    }

    pub(super) fn end_instance(&mut self, id: InstanceId, ended: Ended) -> bool {
        if let Some(instance) = self.instances.alive.get_mut(&id) {
            instance.status = Status::Finished;
            instance.ended = Some(ended);
        }
        true
    }

    /// A finished result that nothing can change any more.
    fn settle_result(&mut self, context: &Context<'_>, id: InstanceId, place: &Place) {
        let Some(instance) = self.instances.alive.get(&id) else { return };
        if instance.settled || instance.ended.is_none() || place.speculative {
            return;
        }
        let flows = match instance.role {
            Role::Node => context.analysis.state(instance.state).flows.clone(),
            Role::Exit => match &context.program.state(instance.state).kind {
                StateKind::Sequence { outputs, .. } => outputs.iter().flat_map(|o| o.value.flows()).collect(),
                _ => Vec::new(),
            },
            _ => Vec::new(),
        };
        let settled = self.instances.flows_settled(&instance.environment, &flows)
            && !instance.reads.overlaps(&place.written)
            && !instance.senses.overlaps(&place.written)
            && self.deviation(id, &place.world).is_none();
        if let Some(instance) = self.instances.alive.get_mut(&id) {
            instance.settled = settled;
        }
    }
}
