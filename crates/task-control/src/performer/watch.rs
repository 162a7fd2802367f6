//! What the world pool tells of its root while a run is under way.

use super::Answer;
use super::told::{Told, maker};
use crate::record::said;
use ratn_executive::protocol::Event;
use ratn_model::id::{InstanceId, Revision};
use ratn_proto::types::WorldUpdate;
use ratn_worker::client::{CallError, WorldClient};
use ratn_worker::client::{PAUSE, retry_unanswered};
use tokio::sync::mpsc;

/// Tells of every revision after one, in order and without a gap, as long as somebody listens. A pool that comes back with its
/// state is heard again where it was; with one that has lost it the run cannot go on.
pub(super) async fn follow(world: WorldClient, mut after: Revision, events: mpsc::Sender<Answer>, heard: Told) {
    loop {
        let told = tell(&world, &mut after, &events, &heard).await;
        if events.is_closed() {
            return;
        }
        match told {
            // The watch ended with its pool, which may come back.
            Ok(()) => {}
            Err(error) if error.is_crash() => {}
            Err(error) => {
                let reason = format!("the world pool does not tell of its revisions after {after}: {}", said(&error));
                let failed = Event::RetirementFailed { instance: InstanceId(0), reason };
                let _ = events.send(failed.into()).await;
                return;
            }
        }
        tokio::time::sleep(PAUSE).await;
    }
}

async fn tell(
    world: &WorldClient,
    after: &mut Revision,
    events: &mpsc::Sender<Answer>,
    heard: &Told,
) -> Result<(), CallError> {
    let mut watch = retry_unanswered(|| world.watch(Some(*after), &[])).await?;
    while let Some(update) = watch.next().await? {
        if let WorldUpdate::Changed(change) = update {
            *after = change.revision;
            let made_by = maker(&change);
            if events.send(Answer::World(change)).await.is_err() {
                return Ok(());
            }
            heard.hear(*after, made_by);
        }
    }
    Ok(())
}
