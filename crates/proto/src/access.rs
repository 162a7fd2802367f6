//! What each method of the wire does, as its option `(access)` in the proto says. Which roles may is for a gate to say.

/// What can be done, as far as roles tell it apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Operation {
    /// Health and reflection of gRPC; no method of this system.
    Ask,
    /// Listing, watching, querying, explaining.
    Look,
    /// Opening a session and keeping it alive.
    Session,
    /// Adding resources to the pool.
    Create,
    /// Using capacity up.
    Consume,
    /// Removing resources from the pool.
    Delete,
    /// Blocking, and taking it back.
    Acquire,
    /// Giving a lease back.
    Release,
    /// Making and dropping projections.
    Project,
    /// Changing the root world.
    Commit,
    /// Giving goals to providers, and stopping them.
    Perform,
    /// Starting and stopping processes, resetting the cell, letting a robot move again.
    Administer,
    /// Being asked for what is missing, and saying why there is no more of it.
    Provide,
}

/// A method of this system.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Method {
    /// Its service, `ratn.v1.ResourceService`.
    pub service: &'static str,
    /// Its name, `Create`.
    pub name: &'static str,
    /// What it does; nobody may where the proto does not say.
    pub operation: Option<Operation>,
}

/// Every method of every service of the proto.
pub const METHODS: &[Method] = include!("generated/ratn_v1_methods.rs");

/// The method of a request's path, `/ratn.v1.ResourceService/Create`, if it is one of this system's.
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
