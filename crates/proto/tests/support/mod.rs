//! Messages made from the schema itself: every message with every field set, and every place in it where a text can be.
//!
//! What is made is valid where the schema alone cannot say so (a quaternion has length one, a trajectory as many numbers as joints),
//! so that a message is refused for the one thing that a test changes in it, and for nothing else.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, reason = "a test may panic, and uses what it needs")]

use prost::Message;
use prost::encoding::{WireType, encode_key, encode_varint};
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FieldDescriptorProto, FileDescriptorSet};
use std::collections::BTreeMap;

/// Below this many messages a choice is its first one, which has none below it.
const MAX_DEPTH: usize = 8;
/// What every text is unless a test says otherwise.
const TEXT: &str = "a";

/// The messages and methods of `ratn.v1`.
pub struct Schema {
    messages: BTreeMap<String, DescriptorProto>,
    /// Path of the method, its request, whether it takes a stream of them.
    pub methods: Vec<(String, String, bool)>,
}

/// A place in a message: field by field, with the keys and elements on the way.
pub type Place = Vec<String>;

impl Schema {
    pub fn read() -> Schema {
        let set = FileDescriptorSet::decode(ratn_proto::FILE_DESCRIPTOR_SET).unwrap();
        let (mut messages, mut methods) = (BTreeMap::new(), Vec::new());
        for file in set.file.into_iter().filter(|file| file.package() == "ratn.v1") {
            for service in &file.service {
                for method in &service.method {
                    let path = format!("/ratn.v1.{}/{}", service.name(), method.name());
                    methods.push((path, method.input_type().to_owned(), method.client_streaming()));
                }
            }
            for message in file.message_type {
                for entry in &message.nested_type {
                    messages.insert(format!(".ratn.v1.{}.{}", message.name(), entry.name()), entry.clone());
                }
                messages.insert(format!(".ratn.v1.{}", message.name()), message);
            }
        }
        Schema { messages, methods }
    }

    /// Every message by its full name, `.ratn.v1.Goal`.
    pub fn names(&self) -> impl Iterator<Item = &String> {
        self.messages.keys()
    }

    /// A message with every field set.
    pub fn example(&self, message: &str) -> Vec<u8> {
        self.encode(message, &[], "", 0)
    }

    /// The same with one text in it, at a place.
    pub fn with_text(&self, message: &str, place: &[String], text: &str) -> Vec<u8> {
        self.encode(message, place, text, 0)
    }

    /// Where in a message texts are: the value of a field, or the key of a map.
    pub fn texts(&self, message: &str) -> Vec<Place> {
        let mut places = Vec::new();
        self.collect(message, &mut Vec::new(), &mut places);
        places
    }

    fn collect(&self, message: &str, on_the_way: &mut Place, places: &mut Vec<Place>) {
        // A value in a list in a value is as a value: once is enough.
        let entered = |name: &str| on_the_way.iter().filter(|step| step.ends_with(&format!("@{name}"))).count();
        if on_the_way.len() >= 2 * MAX_DEPTH || entered(message) > 1 {
            return;
        }
        for field in &self.messages[message].field {
            on_the_way.push(format!("{}@{message}", field.name()));
            match field.r#type() {
                Type::String => places.push(on_the_way.clone()),
                Type::Message => self.collect(field.type_name(), on_the_way, places),
                _ => {}
            }
            on_the_way.pop();
        }
    }

    fn encode(&self, message: &str, place: &[String], text: &str, depth: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        let descriptor = &self.messages[message];
        let wanted = place.first().and_then(|step| step.split('@').next());
        let mut chosen = BTreeMap::new();
        for field in &descriptor.field {
            let is_wanted = wanted == Some(field.name());
            if let Some(choice) = field.oneof_index.filter(|_| !field.proto3_optional()) {
                let first_or_wanted = chosen.entry(choice).or_insert_with(|| {
                    let of_it = descriptor.field.iter().filter(|other| other.oneof_index == Some(choice));
                    let names: Vec<&str> = of_it.map(FieldDescriptorProto::name).collect();
                    wanted.filter(|wanted| names.contains(wanted)).unwrap_or(names[0]).to_owned()
                });
                if first_or_wanted != field.name() {
                    continue;
                }
            }
            if !is_wanted && depth >= MAX_DEPTH && field.r#type() == Type::Message {
                continue;
            }
            let inner = if is_wanted { &place[1..] } else { &[] };
            self.encode_field(field, is_wanted && inner.is_empty(), inner, text, depth, &mut bytes);
        }
        bytes
    }

    fn encode_field(
        &self,
        field: &FieldDescriptorProto,
        is_target: bool,
        inner: &[String],
        text: &str,
        depth: usize,
        bytes: &mut Vec<u8>,
    ) {
        let number = u32::try_from(field.number()).unwrap();
        let mut delimited = |content: &[u8]| {
            encode_key(number, WireType::LengthDelimited, bytes);
            encode_varint(content.len() as u64, bytes);
            bytes.extend_from_slice(content);
        };
        match field.r#type() {
            Type::String => delimited(if is_target { text } else { TEXT }.as_bytes()),
            Type::Bytes => delimited(&[1, 2, 3]),
            Type::Message => delimited(&self.encode(field.type_name(), inner, text, depth + 1)),
            Type::Double if field.label() == Label::Repeated => {
                let numbers: &[f64] = match field.name() {
                    "position_m" => &[1.0, 2.0, 3.0],
                    "quaternion_xyzw" => &[0.0, 0.0, 0.0, 1.0],
                    // As many as there are joints.
                    _ => &[0.5],
                };
                delimited(&numbers.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>());
            }
            Type::Double => {
                encode_key(number, WireType::SixtyFourBit, bytes);
                bytes.extend_from_slice(&1.0_f64.to_le_bytes());
            }
            _ => {
                encode_key(number, WireType::Varint, bytes);
                encode_varint(1, bytes);
            }
        }
    }
}

/// As an error names it, `requirement.attributes`; steps into lists and maps are left out.
pub fn spelt(place: &[String]) -> String {
    place.iter().filter_map(|step| step.split('@').next()).collect::<Vec<_>>().join(".")
}
