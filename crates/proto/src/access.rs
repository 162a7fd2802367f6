//! What each method does, from its option `(access)` in the proto. Which roles may call it is decided elsewhere.

/// Operations that roles distinguish.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Operation {
    /// Health and reflection of gRPC; no method of this system.
    Ask,
    /// Listing, watching, querying, explaining.
    Look,
    /// Opening sessions and keeping them alive.
    Session,
    /// Adding resources to the pool.
    Create,
    /// Consuming capacity.
    Consume,
    /// Removing resources from the pool.
    Delete,
    /// Blocking (leasing), and withdrawing such requests.
    Acquire,
    /// Releasing leases.
    Release,
    /// Creating and releasing projections.
    Project,
    /// Committing changes to the root world.
    Commit,
    /// Giving goals to providers, and cancelling them.
    Perform,
    /// Starting and stopping processes, resetting the cell, letting a robot move again.
    Administer,
    /// Receiving demand for missing resources, and reporting shortages.
    Provide,
}

/// A method of this system.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Method {
    /// The name of its service, `ratn.v1.ResourceService`.
    pub service: &'static str,
    /// The name of the method, `Create`.
    pub name: &'static str,
    /// What it does; without an operation nobody may call it.
    pub operation: Option<Operation>,
}

/// Every method of every service of the proto.
pub const METHODS: &[Method] = include!("generated/ratn_v1_methods.rs");

/// Finds the method with a request's path, `/ratn.v1.ResourceService/Create`.
pub fn method_of(path: &str) -> Option<&'static Method> {
    let (service, name) = path.strip_prefix('/')?.split_once('/')?;
    METHODS.iter().find(|method| method.service == service && method.name == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_method_is_found_by_its_path_with_what_its_option_says() {
        let operation = |path| method_of(path).and_then(|method| method.operation);
        assert_eq!(operation("/ratn.v1.ResourceService/Create"), Some(Operation::Create));
        assert_eq!(operation("/ratn.v1.SafetyService/ClearEmergencyStop"), Some(Operation::Administer));
        for unknown in ["/ratn.v1.ResourceService/Forget", "/ratn.v1.ResourceService", "Create", ""] {
            assert_eq!(method_of(unknown), None, "{unknown}");
        }
    }
}
