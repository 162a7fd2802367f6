//! The MCAP container, version 0 (mcap.dev/spec): records in uncompressed chunks, with an index at the end.
//!
//! Of a written chunk only its index is kept in memory, about 100 bytes per MiB.

use std::collections::BTreeMap;
use std::io::{self, Write};

const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', b'0', b'\r', b'\n'];
/// A chunk is closed when it exceeds this size.
const CHUNK_BYTES: usize = 1 << 20;

#[derive(Debug, Clone, Copy)]
#[repr(u8)]
enum Op {
    Header = 0x01,
    Footer = 0x02,
    Schema = 0x03,
    Channel = 0x04,
    Message = 0x05,
    Chunk = 0x06,
    MessageIndex = 0x07,
    ChunkIndex = 0x08,
    Statistics = 0x0b,
    SummaryOffset = 0x0e,
    DataEnd = 0x0f,
}

/// A file that is being written.
pub(crate) struct File<W> {
    out: W,
    written: u64,
    channels: Vec<Channel>,
    chunk: Chunk,
    chunks: Vec<Vec<u8>>,
    first_ns: u64,
    last_ns: u64,
}

struct Channel {
    /// Its schema record and its channel record.
    schema: Vec<u8>,
    channel: Vec<u8>,
    messages: u64,
}

#[derive(Default)]
struct Chunk {
    records: Vec<u8>,
    first_ns: u64,
    last_ns: u64,
    /// By channel: time and offset in the chunk of each message.
    messages: BTreeMap<u16, Vec<(u64, u64)>>,
}

impl<W: Write> File<W> {
    pub(crate) fn begin(out: W) -> io::Result<File<W>> {
        let (channels, chunks) = (Vec::new(), Vec::new());
        let mut file =
            File { out, written: 0, channels, chunk: Chunk::default(), chunks, first_ns: u64::MAX, last_ns: 0 };
        file.write(&MAGIC)?;
        let header = Fields::default().text("").text(concat!("ratn ", env!("CARGO_PKG_VERSION")));
        file.record(Op::Header, &header.0)?;
        Ok(file)
    }

    /// Adds a topic with its schema. Returns the channel's number, for [`File::message`].
    pub(crate) fn channel(&mut self, topic: &str, encoding: &str, schema: (&str, &str, &[u8])) -> io::Result<u16> {
        let id = self.channels.len() as u16 + 1;
        let (name, schema_encoding, data) = schema;
        let schema = Fields::default().u16(id).text(name).text(schema_encoding).bytes(data).0;
        let channel = Fields::default().u16(id).u16(id).text(topic).text(encoding).bytes(&[]).0;
        self.record(Op::Schema, &schema)?;
        self.record(Op::Channel, &channel)?;
        self.channels.push(Channel { schema, channel, messages: 0 });
        Ok(id)
    }

    pub(crate) fn message(&mut self, channel: u16, at_ns: u64, data: &[u8]) -> io::Result<()> {
        let of = &mut self.channels[usize::from(channel) - 1];
        // The sequence number of a message may wrap around.
        let number = of.messages as u32;
        of.messages += 1;
        let chunk = &mut self.chunk;
        if chunk.records.is_empty() {
            (chunk.first_ns, chunk.last_ns) = (at_ns, at_ns);
        }
        (chunk.first_ns, chunk.last_ns) = (chunk.first_ns.min(at_ns), chunk.last_ns.max(at_ns));
        (self.first_ns, self.last_ns) = (self.first_ns.min(at_ns), self.last_ns.max(at_ns));
        chunk.messages.entry(channel).or_default().push((at_ns, chunk.records.len() as u64));
        let head = Fields::default().u16(channel).u32(number).u64(at_ns).u64(at_ns).0;
        chunk.records.push(Op::Message as u8);
        chunk.records.extend(((head.len() + data.len()) as u64).to_le_bytes());
        chunk.records.extend(head);
        chunk.records.extend(data);
        if chunk.records.len() >= CHUNK_BYTES { self.close_chunk() } else { Ok(()) }
    }

    fn close_chunk(&mut self) -> io::Result<()> {
        if self.chunk.records.is_empty() {
            return Ok(());
        }
        let mut chunk = std::mem::take(&mut self.chunk);
        let size = chunk.records.len() as u64;
        let (start, times) = (self.written, Fields::default().u64(chunk.first_ns).u64(chunk.last_ns));
        // No checksum and no compression.
        let head = times.u64(size).u32(0).text("").u64(size).0;
        self.write(&[Op::Chunk as u8])?;
        self.write(&(head.len() as u64 + size).to_le_bytes())?;
        self.write(&head)?;
        self.write(&chunk.records)?;
        let length = self.written - start;
        let mut offsets = Fields::default();
        let indexes_start = self.written;
        for (channel, messages) in chunk.messages.iter().filter(|(_, messages)| !messages.is_empty()) {
            offsets = offsets.u16(*channel).u64(self.written);
            let entries = messages.iter().fold(Fields::default(), |all, (at, offset)| all.u64(*at).u64(*offset));
            self.record(Op::MessageIndex, &Fields::default().u16(*channel).bytes(&entries.0).0)?;
        }
        let indexes = self.written - indexes_start;
        // The memory is reused for the next chunk.
        chunk.records.clear();
        chunk.messages.values_mut().for_each(Vec::clear);
        let index = Fields::default().u64(chunk.first_ns).u64(chunk.last_ns).u64(start).u64(length);
        self.chunks.push(index.bytes(&offsets.0).u64(indexes).text("").u64(size).u64(size).0);
        self.chunk = chunk;
        Ok(())
    }

    pub(crate) fn end(&mut self) -> io::Result<()> {
        self.close_chunk()?;
        self.record(Op::DataEnd, &Fields::default().u32(0).0)?;
        let summary = self.written;
        let mut groups: Vec<(Op, u64, u64)> = Vec::new();
        let channels = std::mem::take(&mut self.channels);
        let schemas = channels.iter().map(|one| one.schema.as_slice());
        groups.extend(self.group(Op::Schema, schemas)?);
        groups.extend(self.group(Op::Channel, channels.iter().map(|one| one.channel.as_slice()))?);
        let chunks = std::mem::take(&mut self.chunks);
        groups.extend(self.group(Op::ChunkIndex, chunks.iter().map(Vec::as_slice))?);
        let counts =
            channels.iter().zip(1_u16..).fold(Fields::default(), |all, (one, id)| all.u16(id).u64(one.messages));
        let (kinds, messages) = (channels.len(), channels.iter().map(|one| one.messages).sum());
        let first_ns = if self.first_ns == u64::MAX { 0 } else { self.first_ns };
        let statistics = Fields::default().u64(messages).u16(kinds as u16).u32(kinds as u32).u32(0).u32(0);
        let statistics = statistics.u32(chunks.len() as u32).u64(first_ns).u64(self.last_ns).bytes(&counts.0).0;
        groups.extend(self.group(Op::Statistics, [statistics.as_slice()].into_iter())?);
        let offsets = self.written;
        for (op, start, length) in groups {
            self.record(Op::SummaryOffset, &Fields::default().u8(op as u8).u64(start).u64(length).0)?;
        }
        self.record(Op::Footer, &Fields::default().u64(summary).u64(offsets).u32(0).0)?;
        self.write(&MAGIC)
    }

    /// Writes a group of records of one kind; returns its position, `None` if it is empty.
    fn group<'a>(&mut self, op: Op, records: impl Iterator<Item = &'a [u8]>) -> io::Result<Option<(Op, u64, u64)>> {
        let start = self.written;
        for record in records {
            self.record(op, record)?;
        }
        Ok((self.written > start).then_some((op, start, self.written - start)))
    }

    fn record(&mut self, op: Op, content: &[u8]) -> io::Result<()> {
        self.write(&[op as u8])?;
        self.write(&(content.len() as u64).to_le_bytes())?;
        self.write(content)
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.written += bytes.len() as u64;
        self.out.write_all(bytes)
    }
}

/// The fields of a record, one after the other.
#[derive(Default)]
struct Fields(Vec<u8>);

impl Fields {
    fn u8(mut self, value: u8) -> Fields {
        self.0.push(value);
        self
    }

    fn u16(mut self, value: u16) -> Fields {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u32(mut self, value: u32) -> Fields {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u64(mut self, value: u64) -> Fields {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn bytes(self, value: &[u8]) -> Fields {
        let mut fields = self.u32(value.len() as u32);
        fields.0.extend(value);
        fields
    }

    fn text(self, value: &str) -> Fields {
        self.bytes(value.as_bytes())
    }
}
