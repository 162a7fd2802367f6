//! A log from one place to another, whatever each is kept in: from files to etcd and back.

use crate::error::{CompactError, CopyError, OpenError, ReadError};
use crate::store::{Position, Recovered, Store, Writer};

/// What stands in place of the records of a snapshot: the position that the snapshot stands for. Nobody reads it.
const PLACEHOLDER: &[u8] = b"";

/// Copies a log into one that is empty. Its records get positions of their own; what they say is the same. The source's place is taken
/// meanwhile, so that nothing is written there that the copy lacks. Holds the whole log in memory. Blocks.
///
/// The target's place is held until the end. The target is marked as unfinished first, and the mark is removed last: of a copy that was
/// interrupted nobody opens the part that is there.
/// Before that the source is marked as moved ([`Writer::mark_moved`](crate::Writer::mark_moved)), so that nobody goes on with it: there are never two that can be opened.
/// Interrupted between the two, the same copy again finishes it.
///
/// # Errors
/// Where either has a writer, the source cannot be read, the target is not empty, or writing fails: then throw the target away.
pub fn transfer(from: &dyn Store, to: &dyn Store) -> Result<Position, CopyError> {
    let (recovered, mut held) = match from.open() {
        Err(OpenError::Read(ReadError::Moved { place, to: moved, how })) => {
            // Interrupted between the two marks: all of it is there, and the source is no one's any more.
            let finished = to.finish_copy(&moved)?;
            return finished.ok_or(CopyError::Read(ReadError::Moved { place, to: moved, how }));
        }
        opened => opened?,
    };
    let (last, mut copy) = put(recovered, from, to)?;
    let draw = crate::draw::number();
    let draw = draw.map_err(|source| CopyError::Io { action: "draw a number for", place: to.place(), source })?;
    // By the number it is known which copy the source was moved to.
    let moved = format!("{} (copy {draw:016x})", to.place());
    copy.mark_complete(&moved)?;
    held.mark_moved(&moved)?;
    copy.mark_whole()?;
    Ok(last)
}

/// As [`transfer`], of a log that may be written meanwhile: the copy is what it was at one moment. For backups.
///
/// # Errors
/// As [`transfer`].
pub fn transfer_running(from: &dyn Store, to: &dyn Store) -> Result<Position, CopyError> {
    let (last, mut copy) = put(from.read()?, from, to)?;
    copy.mark_whole()?;
    Ok(last)
}

/// All of it, still marked as unfinished.
fn put(recovered: Recovered, from: &dyn Store, to: &dyn Store) -> Result<(Position, Box<dyn Writer>), CopyError> {
    if recovered.last() == Position(0) {
        return Err(CopyError::Nothing { place: from.place() });
    }
    let (there, mut writer) = to.open()?;
    if there.last() != Position(0) {
        return Err(CopyError::NotEmpty { place: to.place() });
    }
    writer.mark_unfinished()?;
    let (mut last, mut durable) = (Position(0), writer.durable());
    if let Some(snapshot) = recovered.snapshot {
        let through = writer.append(PLACEHOLDER)?;
        last = through;
        durable.wait_blocking(through)?;
        let payload = snapshot.payload;
        writer.compact(through, Box::new(move || payload)).map_err(|error| match error {
            CompactError::Stopped(fault) => CopyError::Write(fault.into()),
            other => CopyError::Snapshot(other.to_string()),
        })?;
        // The snapshot counts before anything is put behind it.
        while durable.progress().compacting {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        if let Some(failure) = durable.progress().compaction_failure {
            return Err(CopyError::Snapshot(failure.to_string()));
        }
    }
    for record in &recovered.records {
        last = writer.append(&record.payload)?;
        // One at a time: what waits is bounded.
        durable.wait_blocking(last)?;
    }
    Ok((last, writer))
}
