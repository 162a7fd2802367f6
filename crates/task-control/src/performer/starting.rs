//! Starts the goal of a state: at which provider, under which lease, and behind which other goals and decisions.

use super::Performer;
use super::goal::{self, Given, Performing};
use super::goals::Job;
use crate::safe_on_disk::Mark;
use ratn_event_log::without_visits;
use ratn_executive::protocol::Goal;
use ratn_model::id::InstanceId;
use ratn_model::resource::LeasedResource;
use ratn_model::value::{Type, Value};
use ratn_proto::types;
use ratn_worker::trace;
use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::AtomicBool;
use tokio_util::sync::CancellationToken;

impl Performer {
    /// Gives a goal to its provider, or waits for one that was given before.
    pub(super) fn start(&mut self, instance: InstanceId, attempt: u32, goal: Goal, given: Given, safe: Option<Mark>) {
        let stop = CancellationToken::new();
        let lease = goal.lease.as_ref().map(|lease| lease.id);
        let provider = self.provider_of(&goal);
        let (source, endpoint) = match provider {
            Ok(resource) => (
                resource.id.clone(),
                resource.endpoint.parse().map_err(|error| format!("{} has no usable endpoint: {error}", resource.id)),
            ),
            Err(reason) => (String::new(), Err(reason)),
        };
        let (resource, over) = (source.clone(), CancellationToken::new());
        let acts = self.acts(instance);
        let before = self.goals.before(instance, lease, &source, acts);
        // A goal without a projection reads the root, which has to contain every earlier decision; unless the goal reads no facts.
        let looks_at_root = given != Given::ToStop && goal.projection.is_none() && !goal.reads_nothing;
        let sees = looks_at_root.then(|| (self.recorded.subscribe(), self.decided));
        let (inputs, outputs) = self.ports_of(&goal);
        let performing = Performing {
            instance,
            attempt,
            before,
            endpoint,
            source,
            timeout_s: goal.timeout_s,
            speed: self.speed,
            actions: self.actions.clone(),
            resources: self.resources.clone(),
            channels: self.channels.clone(),
            events: self.events.clone(),
            stop: stop.clone(),
            results: Mutex::default(),
            outputs,
            safe,
            sees,
            over: self.over.clone(),
            told: self.told.clone(),
            may_move: AtomicBool::new(false),
            doubtful: self.goals.doubtful.clone(),
            goal: types::Goal {
                id: format!("{}/{instance}/{attempt}", self.run),
                action: goal.action.to_string(),
                inputs,
                seed: goal.seed,
                lease: goal.lease,
                session: self.run.clone(),
                projection: goal.projection,
                // What says that it reads nothing begins whenever it can, and would see another world in every run.
                world_pool: match goal.projection {
                    None if goal.reads_nothing => String::new(),
                    _ => self.world.endpoint().to_string(),
                },
                deadline_ms: goal::deadline_ms(goal.timeout_s, self.speed),
                grace_ms: goal::GRACE_MS,
                improves: goal.improves.map(Vec::from),
            },
        };
        let ends = over.clone().drop_guard();
        let performing = async move {
            performing.perform(given).await;
            drop(ends);
        };
        let ended = tokio::spawn(trace::within(self.of(instance), performing));
        let job = Job { attempt, lease, resource, acts, stop, ended, over };
        if given == Given::ToStop {
            return self.goals.stop(instance, &job);
        }
        self.goals.awaits(instance, job);
    }

    /// Whether the goal of an instance changes the environment; true if its state is unknown.
    fn acts(&self, instance: InstanceId) -> bool {
        let path = self.paths.get(&instance).map(|path| without_visits(path));
        path.is_none_or(|path| !self.only_looks.contains(&path))
    }

    /// The inputs of a goal in the types of its action's ports, and the output ports that a result must have.
    pub(super) fn ports_of(&self, goal: &Goal) -> (BTreeMap<String, Value>, Vec<String>) {
        let provider = self.catalogue.providers.get(&*goal.provider);
        let Some(action) = provider.and_then(|provider| provider.actions.get(&*goal.action)) else {
            return (goal.inputs.clone(), Vec::new());
        };
        let typed = |(port, value): (&String, &Value)| {
            let ty = action.inputs.get(port).or_else(|| action.optional.get(port)).unwrap_or(&Type::Any);
            (port.clone(), ty.widened(value.clone()))
        };
        (goal.inputs.iter().map(typed).collect(), action.outputs.keys().cloned().collect())
    }

    /// The provider of a goal: the leased resource of its kind.
    fn provider_of<'a>(&self, goal: &'a Goal) -> Result<&'a LeasedResource, String> {
        let Some(provider) = self.catalogue.providers.get(&*goal.provider) else {
            return Err(format!("the system's catalogue has no provider `{}`", goal.provider));
        };
        let leased = goal.lease.as_ref().and_then(|lease| lease.resource(&provider.resource));
        leased.ok_or_else(|| {
            format!(
                "`{}` is done by a {}, and none is leased: add `block: {}` to the state's resources",
                goal.provider, provider.resource, provider.resource
            )
        })
    }
}
