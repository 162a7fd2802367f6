//! Fencing: a lease that is older than one already seen for the same resource has ended, whatever its holder believes.

use ratn_model::id::FencingToken;
use std::collections::BTreeMap;

/// The highest token seen, per resource of this server.
#[derive(Debug, Default)]
pub(crate) struct Fence {
    highest: BTreeMap<String, FencingToken>,
}

impl Fence {
    /// Lets `token` through unless a higher one was seen for `resource`; then that one is the error.
    pub(crate) fn admit(&mut self, resource: &str, token: FencingToken) -> Result<(), FencingToken> {
        match self.highest.get_mut(resource) {
            Some(highest) if token < *highest => return Err(*highest),
            Some(highest) => *highest = token,
            None => {
                self.highest.insert(resource.to_owned(), token);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_lower_than_one_seen_for_the_resource_is_refused() {
        let mut fence = Fence::default();
        assert_eq!(fence.admit("arm", FencingToken(7)), Ok(()));
        assert_eq!(fence.admit("arm", FencingToken(7)), Ok(()));
        assert_eq!(fence.admit("arm", FencingToken(6)), Err(FencingToken(7)));
        assert_eq!(fence.admit("camera", FencingToken(6)), Ok(()));
        assert_eq!(fence.admit("arm", FencingToken(8)), Ok(()));
        assert_eq!(fence.admit("arm", FencingToken(7)), Err(FencingToken(8)));
    }
}
