//! Shared parts of the serialized forms of a checkpoint. A value behind an `Arc` is written once. Leases and requirements are
//! written in full, because their JSON form leaves out empty parts.
//!
//! What a checkpoint contains, and what of the state it leaves out: [`crate::executive::Executive::checkpoint`].

use ratn_model::condition::Condition;
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::resource::{
    Lease, LeasedResource, OperatedUnits, Quantity, Requirement, ResourceClass, ResourceOperation,
};
use ratn_model::value::Value;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Error: these bytes are no checkpoint of this program; the text says what is wrong.
pub(crate) type Broken = &'static str;

/// The serialized forms of values that several owners share, each once, in the order of their first use.
#[derive(Debug)]
pub(crate) struct Pool<F> {
    /// Places by address. Addresses are not written, so the bytes depend on the state alone.
    places: BTreeMap<usize, u32>,
    forms: Vec<F>,
}

impl<F> Default for Pool<F> {
    fn default() -> Pool<F> {
        Pool { places: BTreeMap::new(), forms: Vec::new() }
    }
}

impl<F> Pool<F> {
    /// The place of a value that was added before.
    pub(crate) fn find<T>(&self, shared: &Arc<T>) -> Option<u32> {
        self.places.get(&Arc::as_ptr(shared).addr()).copied()
    }

    /// Adds a value and returns its place.
    pub(crate) fn add<T>(&mut self, shared: &Arc<T>, form: F) -> u32 {
        let place = u32::try_from(self.forms.len()).unwrap_or(u32::MAX);
        self.places.insert(Arc::as_ptr(shared).addr(), place);
        self.forms.push(form);
        place
    }

    pub(crate) fn into_forms(self) -> Vec<F> {
        self.forms
    }
}

/// The value that was written at a place.
pub(crate) fn at<T: Clone>(all: &[T], place: u32, broken: Broken) -> Result<T, Broken> {
    usize::try_from(place).ok().and_then(|place| all.get(place)).cloned().ok_or(broken)
}

type ResourceForm = (String, String, String, Vec<String>);
type UnitsForm = (String, String, Quantity, bool);
type LeaseForm = (LeaseId, FencingToken, Vec<ResourceForm>, Vec<UnitsForm>);

/// Serialization of an optional lease.
pub(crate) mod leases {
    use super::{Deserialize, Deserializer, Lease, LeaseForm, LeasedResource, OperatedUnits, Serialize, Serializer};
    use std::borrow::Borrow;

    pub(crate) fn serialize<L: Borrow<Lease>, S: Serializer>(lease: &Option<L>, to: S) -> Result<S::Ok, S::Error> {
        let form = |lease: &L| -> LeaseForm {
            let Lease { id, token, resources, consumed } = lease.borrow().clone();
            let resource = |resource| {
                let LeasedResource { id, kind, endpoint, superclasses } = resource;
                (id, kind, endpoint, superclasses)
            };
            let units = |one: OperatedUnits| (one.resource, one.kind, one.units, one.ends_with_session);
            (id, token, resources.into_iter().map(resource).collect(), consumed.into_iter().map(units).collect())
        };
        lease.as_ref().map(form).serialize(to)
    }

    pub(crate) fn deserialize<'d, L: From<Lease>, D: Deserializer<'d>>(from: D) -> Result<Option<L>, D::Error> {
        let form = Option::<LeaseForm>::deserialize(from)?;
        Ok(form.map(|(id, token, resources, consumed)| {
            let resource = |(id, kind, endpoint, superclasses)| LeasedResource { id, kind, endpoint, superclasses };
            let units =
                |(resource, kind, units, ends_with_session)| OperatedUnits { resource, kind, units, ends_with_session };
            let (resources, consumed) = (resources.into_iter().map(resource), consumed.into_iter().map(units));
            Lease { id, token, resources: resources.collect(), consumed: consumed.collect() }.into()
        }))
    }
}

type RequirementForm =
    (ResourceOperation, String, Option<ResourceClass>, BTreeMap<String, Value>, Quantity, bool, Vec<Condition>);

/// Serialization of requirements to the resource manager.
pub(crate) mod requirements {
    use super::{Deserialize, Deserializer, Requirement, RequirementForm, Serialize, Serializer};

    pub(crate) fn serialize<S: Serializer>(all: &[Requirement], to: S) -> Result<S::Ok, S::Error> {
        let form = |requirement: &Requirement| -> RequirementForm {
            let Requirement { operation, kind, class, attributes, count, divisible, conditions } = requirement.clone();
            (operation, kind, class, attributes, count, divisible, conditions)
        };
        all.iter().map(form).collect::<Vec<_>>().serialize(to)
    }

    pub(crate) fn deserialize<'d, D: Deserializer<'d>>(from: D) -> Result<Vec<Requirement>, D::Error> {
        let forms = Vec::<RequirementForm>::deserialize(from)?;
        let requirement = |(operation, kind, class, attributes, count, divisible, conditions)| Requirement {
            operation,
            kind,
            class,
            attributes,
            count,
            divisible,
            conditions,
        };
        Ok(forms.into_iter().map(requirement).collect())
    }
}
