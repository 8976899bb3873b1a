//! Where a component is in the plant: names from the top down, as `plant/cell-1/station-a`.

use std::fmt;
use std::str::FromStr;

/// A place. There is at least one name, and none is empty or has a slash.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Place(String);

/// What is no place.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is no place: names with slashes between them, as cell-1/station-a, at most {MOST_NAMES} of 64 letters"
)]
pub struct PlaceFault(String);

impl Place {
    /// The place of something here, under a name of which the slashes and what cannot be printed are left out.
    ///
    /// # Errors
    /// There is no room for one more name, or nothing is left of it.
    pub fn of(&self, name: &str) -> Result<Self, PlaceFault> {
        let name: String = name
            .chars()
            .map(|letter| if letter == '/' { '-' } else { letter })
            .filter(|letter| !letter.is_control())
            .take(MOST_LETTERS)
            .collect();
        format!("{self}/{}", name.trim()).parse()
    }

    /// The last name.
    #[must_use]
    pub fn name(&self) -> &str {
        self.0.rsplit('/').next().unwrap_or_default()
    }
}

impl FromStr for Place {
    type Err = PlaceFault;

    fn from_str(text: &str) -> Result<Self, PlaceFault> {
        let fits = |name: &str| {
            let letters = name.chars().count();
            (1..=MOST_LETTERS).contains(&letters)
                && !name.chars().any(char::is_control)
                && name.trim() == name
        };
        match text.split('/').count() <= MOST_NAMES && text.split('/').all(fits) {
            true => Ok(Self(text.to_owned())),
            false => Err(PlaceFault(text.chars().take(80).collect())),
        }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

const MOST_NAMES: usize = 16;
const MOST_LETTERS: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_grows_downwards_and_has_an_end() {
        let cell: Place = "plant/cell-1".parse().unwrap();
        let gripper = cell.of(" left/gripper\n").unwrap();
        assert_eq!(gripper.to_string(), "plant/cell-1/left-gripper");
        assert_eq!(gripper.name(), "left-gripper");
        assert!(cell.of("\u{7}").is_err());
        let deep = (0..14).try_fold(cell, |place, _| place.of("x"));
        assert!(deep.unwrap().of("x").is_err());
        for text in ["", "/", "a/", "/a", "a//b", "a/ b", "a\tb"] {
            assert!(text.parse::<Place>().is_err(), "{text:?}");
        }
    }
}
