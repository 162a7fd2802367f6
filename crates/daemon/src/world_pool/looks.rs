//! Bounds the work of a call's changes. A deletion by pattern looks at every fact that the index cannot exclude, and at every earlier change of the
//! call. All other calls wait meanwhile.

use ratn_model::fact::Change;
use ratn_world::world::World;

/// Maximum number of facts and changes that the changes of a call may look at; about a tenth of a second.
const MOST: usize = 1_000_000;

/// The changes of a call would look at too many facts.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the deletions by patterns (`?`) of these changes would look at more than {MOST} facts and changes: delete facts by their whole names, or in \
     several calls"
)]
pub(super) struct TooManyLooks;

/// Whether the changes stay within the bound in this world.
pub(super) fn check(world: &World, changes: &[Change]) -> Result<(), TooManyLooks> {
    let mut left = MOST;
    for (earlier, change) in changes.iter().enumerate() {
        let Change::Delete { pattern } = change else { continue };
        if pattern.arguments.iter().all(Option::is_some) {
            continue;
        }
        left = left.saturating_sub(1 + earlier);
        world.each_fact(pattern, &mut |_, _| {
            left = left.saturating_sub(1);
            left > 0
        });
        if left == 0 {
            return Err(TooManyLooks);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::fact::{FactKey, FactPattern, Term};
    use ratn_model::id::Revision;
    use ratn_model::value::Value;

    fn key(n: i64) -> FactKey {
        FactKey { predicate: "p".to_owned(), arguments: [n, 7, n].map(Term::Int).to_vec() }
    }

    /// A deletion of facts that do not exist, among those that the index finds by the second argument.
    fn deletion(n: i64) -> Change {
        let arguments = vec![None, Some(Term::Int(7)), Some(Term::Int(-n))];
        Change::Delete { pattern: FactPattern { predicate: "p".to_owned(), arguments } }
    }

    #[test]
    fn deletions_that_look_at_too_much_are_refused_and_those_of_whole_names_are_not() {
        let world = World::from_facts((1..=2_000).map(|n| (key(n), Value::Int(n))), Revision(1));
        let deletions = |count: i64| (1..=count).map(deletion).collect::<Vec<_>>();
        assert_eq!(check(&world, &deletions(400)), Ok(()));
        assert_eq!(check(&world, &deletions(600)), Err(TooManyLooks));
        let by_name = |n| Change::Delete { pattern: FactPattern::of(&key(n)) };
        assert_eq!(check(&world, &(1..=20_000).map(by_name).collect::<Vec<_>>()), Ok(()));
        // Facts that the same call has written are looked at, too.
        let written = (1..=20_000).map(|n| Change::Set { fact: key(n), value: Value::Null });
        let changes: Vec<Change> = written.chain(deletions(100)).collect();
        assert_eq!(check(&World::from_facts([], Revision(1)), &changes), Err(TooManyLooks));
    }
}
