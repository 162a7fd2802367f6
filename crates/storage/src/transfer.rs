//! Copies a log from one place to another, whatever keeps each of them: from files to etcd and back.

use crate::error::{CompactError, CopyError, OpenError, ReadError};
use crate::store::{Position, Recovered, Store, Writer};

/// The record that replaces the records of a snapshot, at the position of the snapshot. It is never read.
const PLACEHOLDER: &[u8] = b"";

/// Copies a log into an empty one. Its records get new positions; their payloads are the same. The source's place is held meanwhile, so
/// that nothing is written there that the copy lacks. Holds the whole log in memory. Blocks.
///
/// The target's place is held until the end. The target is marked as unfinished first, and that mark is removed last: a partial copy cannot
/// be opened. Before that the source is marked as moved ([`Writer::mark_moved`](crate::Writer::mark_moved)), so that it cannot be
/// continued: there are never two logs that can be opened. If the copy is interrupted between the two marks, repeating it finishes it.
///
/// # Errors
/// Either log has a writer, the source cannot be read, the target is not empty, or writing fails: then discard the target.
pub fn transfer(from: &dyn Store, to: &dyn Store) -> Result<Position, CopyError> {
    let (recovered, mut held) = match from.open() {
        Err(OpenError::Read(ReadError::Moved { place, to: moved, how })) => {
            // Interrupted between the two marks: the copy is complete, and the source is marked as moved.
            let finished = to.finish_copy(&moved)?;
            return finished.ok_or(CopyError::Read(ReadError::Moved { place, to: moved, how }));
        }
        opened => opened?,
    };
    let (last, mut copy) = put(recovered, from, to)?;
    let draw = crate::draw::number();
    let draw = draw.map_err(|source| CopyError::Io { action: "draw a number for", place: to.place(), source })?;
    // The number tells to which copy the source was moved.
    let moved = format!("{} (copy {draw:016x})", to.place());
    copy.mark_complete(&moved)?;
    held.mark_moved(&moved)?;
    copy.mark_whole()?;
    Ok(last)
}

/// As [`transfer`], for a log that may be written meanwhile: the copy has the state of one moment. For backups.
///
/// # Errors
/// As [`transfer`].
pub fn transfer_running(from: &dyn Store, to: &dyn Store) -> Result<Position, CopyError> {
    let (last, mut copy) = put(from.read()?, from, to)?;
    copy.mark_whole()?;
    Ok(last)
}

/// Copies everything; the target is still marked as unfinished.
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
        // The snapshot has to count before anything is appended after it.
        while durable.progress().compacting {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        if let Some(failure) = durable.progress().compaction_failure {
            return Err(CopyError::Snapshot(failure.to_string()));
        }
    }
    for record in &recovered.records {
        last = writer.append(&record.payload)?;
        // One record at a time, because the waiting bytes are bounded.
        durable.wait_blocking(last)?;
    }
    Ok((last, writer))
}
