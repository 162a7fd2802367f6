//! Characters that names, ids and lines of text must not contain: those that a reader does not see or takes for others. With them,
//! two different names could look the same.

use std::ops::RangeInclusive;

/// In addition to control characters: format characters and other characters without a glyph (Unicode's
/// `Default_Ignorable_Code_Point` and `Cf`), line separators, and unusual spaces.
const UNSEEN: [RangeInclusive<char>; 28] = [
    '\u{a0}'..='\u{a0}',
    '\u{ad}'..='\u{ad}',
    '\u{34f}'..='\u{34f}',
    '\u{600}'..='\u{605}',
    '\u{61c}'..='\u{61c}',
    '\u{6dd}'..='\u{6dd}',
    '\u{70f}'..='\u{70f}',
    '\u{890}'..='\u{891}',
    '\u{8e2}'..='\u{8e2}',
    '\u{115f}'..='\u{1160}',
    '\u{1680}'..='\u{1680}',
    '\u{17b4}'..='\u{17b5}',
    '\u{180b}'..='\u{180f}',
    '\u{2000}'..='\u{200f}',
    '\u{2028}'..='\u{202f}',
    '\u{205f}'..='\u{206f}',
    '\u{2800}'..='\u{2800}',
    '\u{3000}'..='\u{3000}',
    '\u{3164}'..='\u{3164}',
    '\u{fe00}'..='\u{fe0f}',
    '\u{feff}'..='\u{feff}',
    '\u{ffa0}'..='\u{ffa0}',
    '\u{fff0}'..='\u{fffb}',
    '\u{110bd}'..='\u{110cd}',
    '\u{13430}'..='\u{1343f}',
    '\u{1bca0}'..='\u{1bca3}',
    '\u{1d173}'..='\u{1d17a}',
    '\u{e0000}'..='\u{e0fff}',
];

/// Whether a reader cannot see this character, or takes it for a space.
pub fn is_unseen(character: char) -> bool {
    character.is_control() || UNSEEN.iter().any(|range| range.contains(&character))
}

/// The rule for names of resource kinds, in words; see [`is_kind`].
pub const KIND_RULE: &str = "a letter, then letters, digits, `_` and `-`";

/// Whether a text is the name of a kind of resource: a letter, then letters, digits, `_` and `-`, all of ASCII.
pub fn is_kind(text: &str) -> bool {
    text.starts_with(|first: char| first.is_ascii_alphabetic())
        && text.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_seen_is_found_and_what_is_written_is_not() {
        for unseen in
            "\u{200b}\u{200d}\u{202e}\u{2060}\u{feff}\u{ad}\u{a0}\u{2028}\u{e0041}\u{fe0f}\n\u{7f}\u{85}".chars()
        {
            assert!(is_unseen(unseen), "{unseen:?}");
        }
        for seen in "arm@sim pose_2/Größe→Ω×ß漢字한글עברית🦾-(.)".chars() {
            assert!(!is_unseen(seen), "{seen:?}");
        }
        assert!(UNSEEN.windows(2).all(|two| two[0].end() < two[1].start()), "in order");
    }

    #[test]
    fn a_kind_is_a_letter_then_letters_digits_underscores_and_hyphens() {
        for kind in ["A", "PathPlanner", "arm_2-left", "not"] {
            assert!(is_kind(kind), "{kind}");
        }
        for other in ["", "2Arm", "_Arm", "-", "Arm left", "Arm.left", "Gr\u{f6}\u{df}e", "Arm\u{200b}"] {
            assert!(!is_kind(other), "{other:?}");
        }
    }
}
