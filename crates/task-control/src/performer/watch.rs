//! What the world pool tells of its root while a run is under way.

use super::Answer;
use super::told::{Told, maker};
use crate::record::said;
use ratn_executive::protocol::{Event, Unmade};
use ratn_model::id::{InstanceId, Revision};
use ratn_proto::types::WorldUpdate;
use ratn_worker::client::{CallError, WorldClient};
use ratn_worker::client::{PAUSE, retry_unanswered};
use tokio::sync::mpsc;

/// So many revisions before the run are looked at, for whose they are: a resource may be given on by who made one of them.
const LOOK_BACK: u64 = 256;

/// Tells of every revision after one, in order and without a gap, as long as somebody listens. A pool that comes back with its
/// state is heard again where it was; with one that has lost it the run cannot go on.
pub(super) async fn follow(world: WorldClient, after: Revision, events: mpsc::Sender<Answer>, heard: Told) {
    let mut from = Revision(after.0.saturating_sub(LOOK_BACK));
    loop {
        let told = tell(&world, &mut from, after, &events, &heard).await;
        if events.is_closed() {
            return;
        }
        match told {
            // The watch ended with its pool, which may come back.
            Ok(()) => {}
            Err(error) if error.is_crash() => {}
            // The pool does not keep what was so long ago.
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
