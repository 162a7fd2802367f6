//! Watches the root of the world pool while a run is under way.

use super::Answer;
use super::told::{Told, maker};
use crate::record::said;
use ratn_executive::protocol::{Event, Unmade};
use ratn_model::id::{InstanceId, Revision};
use ratn_proto::types::WorldUpdate;
use ratn_worker::client::{CallError, WorldClient};
use ratn_worker::client::{PAUSE, retry_unanswered};
use tokio::sync::mpsc;

/// This many revisions before the run are read, to learn which runs made them: one of these runs may hand a resource over.
const LOOK_BACK: u64 = 256;

/// Reports every revision after `after`, in order and without gaps, as long as somebody receives. The watch of a pool that returns with its state is
/// continued; if the pool has lost its state, the run cannot go on.
pub(super) async fn follow(world: WorldClient, after: Revision, events: mpsc::Sender<Answer>, heard: Told) {
    let mut from = Revision(after.0.saturating_sub(LOOK_BACK));
    loop {
        let told = tell(&world, &mut from, after, &events, &heard).await;
        if events.is_closed() {
            return;
        }
        match told {
            // The watch ended with its pool, which may return.
            Ok(()) => {}
            Err(error) if error.is_crash() => {}
            // The pool's history does not reach back that far.
            Err(_) if from < after => {
                from = after;
                continue;
            }
            Err(error) => {
                let reason = format!("the world pool does not tell of its revisions after {from}: {}", said(&error));
                let failed = Event::RetirementFailed { instance: InstanceId(0), reason, unmade: Unmade::Untried };
                let _ = events.send(failed.into()).await;
                return;
            }
        }
        tokio::time::sleep(PAUSE).await;
    }
}

async fn tell(
    world: &WorldClient,
    from: &mut Revision,
    after: Revision,
    events: &mpsc::Sender<Answer>,
    heard: &Told,
) -> Result<(), CallError> {
    let mut watch = retry_unanswered(|| world.watch(Some(*from), &[])).await?;
    while let Some(update) = watch.next().await? {
        if let WorldUpdate::Changed(change) = update {
            *from = change.revision;
            let made_by = maker(&change.commit);
            if *from > after && events.send(Answer::World(change)).await.is_err() {
                return Ok(());
            }
            heard.hear(*from, made_by);
        }
    }
    Ok(())
}
