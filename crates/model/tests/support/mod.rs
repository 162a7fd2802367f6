//! What several test files need.

use ratn_model::catalogue::Catalogue;

/// The standard actions, of which the catalogue says nothing: what is refused then is what states say themselves.
pub(crate) fn unannotated() -> Catalogue {
    let mut catalogue = Catalogue::standard();
    let actions = catalogue.providers.values_mut().flat_map(|provider| provider.actions.values_mut());
    actions.for_each(|action| action.annotations = Default::default());
    catalogue
}
