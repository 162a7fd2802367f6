//! A log whose writer accepts so many records and no more; that a copy of them is whole counts as one.

use ratn_storage::{
    AppendError, CompactError, CopyError, Durable, Fault, MakeSnapshot, OpenError, Place, Position, ReadError,
    Recovered, Store, Writer,
};

#[derive(Debug)]
pub(crate) struct Interrupted {
    pub(crate) store: Box<dyn Store>,
    pub(crate) after: usize,
}

#[derive(Debug)]
struct Ends {
    writer: Box<dyn Writer>,
    left: usize,
}

impl Store for Interrupted {
    fn open(&self) -> Result<(Recovered, Box<dyn Writer>), OpenError> {
        let (recovered, writer) = self.store.open()?;
        Ok((recovered, Box::new(Ends { writer, left: self.after })))
    }

    fn read(&self) -> Result<Recovered, ReadError> {
        self.store.read()
    }

    fn finish_copy(&self, moved: &str) -> Result<Option<Position>, CopyError> {
        self.store.finish_copy(moved)
    }

    fn place(&self) -> String {
        self.store.place()
    }
}

impl Writer for Ends {
    fn append(&mut self, record: &[u8]) -> Result<Position, AppendError> {
        self.left = self.left.checked_sub(1).ok_or(Fault::Closed)?;
        self.writer.append(record)
    }

    fn durable(&self) -> Durable {
        self.writer.durable()
    }

    fn compact(&mut self, through: Position, snapshot: MakeSnapshot) -> Result<(), CompactError> {
        self.writer.compact(through, snapshot)
    }

    fn place(&self) -> Box<dyn Place> {
        self.writer.place()
    }

    fn mark_unfinished(&mut self) -> Result<(), CopyError> {
        self.writer.mark_unfinished()
    }

    fn mark_complete(&mut self, moved: &str) -> Result<(), CopyError> {
        self.writer.mark_complete(moved)
    }

    fn mark_whole(&mut self) -> Result<(), CopyError> {
        self.left = self.left.checked_sub(1).ok_or(Fault::Closed)?;
        self.writer.mark_whole()
    }

    fn mark_moved(&mut self, to: &str) -> Result<(), CopyError> {
        self.writer.mark_moved(to)
    }

    fn waiting_bytes(&self) -> usize {
        self.writer.waiting_bytes()
    }

    fn close(self: Box<Self>) -> Result<Position, Fault> {
        self.writer.close()
    }
}
