//! The location of a component in the plant: names from the top down, such as
//! `plant/cell-1/station-a`.

use std::fmt;
use std::str::FromStr;

/// A location: names without slashes. Neither the list nor a name is empty.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PlantLocation(String);

/// Error for an invalid location.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is not a location: give names separated by slashes, such as cell-1/station-a, at most \
     {MOST_NAMES} names of 64 characters"
)]
pub struct PlaceFault(String);

impl PlantLocation {
    /// Returns the location of an object at this location. Slashes in its name are replaced, and
    /// control characters removed.
    ///
    /// # Errors
    /// Fails if the location has too many names, or if no character of the name is left.
    pub fn of(&self, name: &str) -> Result<Self, PlaceFault> {
        let name: String = name
            .chars()
            .map(|letter| if letter == '/' { '-' } else { letter })
            .filter(|letter| !letter.is_control())
            .take(MOST_LETTERS)
            .collect();
        format!("{self}/{}", name.trim()).parse()
    }

    /// Returns the last name.
    #[must_use]
    pub fn name(&self) -> &str {
        self.0.rsplit('/').next().unwrap_or_default()
    }
}

impl FromStr for PlantLocation {
    type Err = PlaceFault;

    fn from_str(text: &str) -> Result<Self, PlaceFault> {
        let fits = |name: &str| {
            let letters = name.chars().count();
            (1..=MOST_LETTERS).contains(&letters)
                && !name.chars().any(char::is_control)
                && name.trim() == name
        };
        if text.split('/').count() <= MOST_NAMES && text.split('/').all(fits) {
            Ok(Self(text.to_owned()))
        } else {
            Err(PlaceFault(text.chars().take(80).collect()))
        }
    }
}

impl fmt::Display for PlantLocation {
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
        let cell: PlantLocation = "plant/cell-1".parse().unwrap();
        let gripper = cell.of(" left/gripper\n").unwrap();
        assert_eq!(gripper.to_string(), "plant/cell-1/left-gripper");
        assert_eq!(gripper.name(), "left-gripper");
        assert!(cell.of("\u{7}").is_err());
        let deep = (0..14).try_fold(cell, |place, _| place.of("x"));
        assert!(deep.unwrap().of("x").is_err());
        for text in ["", "/", "a/", "/a", "a//b", "a/ b", "a\tb"] {
            assert!(text.parse::<PlantLocation>().is_err(), "{text:?}");
        }
    }
}
