//! Reads JSON files with one object or several.

use std::path::Path;

use serde::de::DeserializeOwned;
use serde_json::Deserializer;

use crate::exit::CommandFailure;

/// Returns the text of a file.
pub(crate) fn read(path: &Path) -> Result<String, CommandFailure> {
    let name = path.display().to_string();
    let bytes = type_files::read_bounded(path, LARGEST)
        .map_err(|why| CommandFailure::Io(format!("cannot read {name}: {why}")))?;
    String::from_utf8(bytes)
        .map_err(|_| CommandFailure::Data(format!("{name}: not UTF-8, so no JSON")))
}

/// Maximum size of a file or input, in bytes.
pub(crate) const LARGEST: u64 = 64 << 20;

/// Parses the objects of an array, or a sequence of objects. Errors have line and column.
pub(crate) fn one_or_many<T: DeserializeOwned>(text: &str) -> Result<Vec<T>, serde_json::Error> {
    if text.trim_start().starts_with('[') {
        return serde_json::from_str(text);
    }
    Deserializer::from_str(text).into_iter().collect()
}

/// Returns the failure for invalid JSON, without the list of expected keys.
pub(crate) fn explain(name: &str, error: &serde_json::Error) -> CommandFailure {
    let text = error.to_string();
    let (what, place) = match text.rsplit_once(" at line ") {
        Some((what, place)) => (what, format!(" at line {place}")),
        None => (text.as_str(), String::new()),
    };
    let what = match what.split_once(", expected one of ") {
        Some((what, _)) if what.starts_with("unknown field") => what,
        _ => what,
    };
    CommandFailure::Data(format!("{name}: {what}{place}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shape;

    #[test]
    fn objects_are_read_however_they_are_put_together() {
        for text in ["[1, 2]", " [1,2]\n", "1 2", "1\n2\n"] {
            assert_eq!(one_or_many::<u8>(text).unwrap(), [1, 2], "{text}");
        }
        assert_eq!(one_or_many::<u8>("").unwrap(), Vec::<u8>::new());
    }

    #[test]
    fn what_is_wrong_is_told_with_its_place() {
        let error = one_or_many::<u8>("1\n\"x\"").unwrap_err();
        assert_eq!(
            explain("a.json", &error).to_string(),
            "a.json: invalid type: string \"x\", expected u8 at line 2 column 3"
        );
        let error = one_or_many::<shape::PublisherIdJson>("{\"typ\": 1}").unwrap_err();
        assert_eq!(
            explain("a.json", &error).to_string(),
            "a.json: unknown field `typ`, expected `type` or `value` at line 1 column 6"
        );
        let error = one_or_many::<shape::DatagramJson>("\n{\"publisher\": 1}").unwrap_err();
        assert_eq!(
            explain("a.json", &error).to_string(),
            "a.json: unknown field `publisher` at line 2 column 12"
        );
    }
    #[test]
    fn json_that_nests_too_deep_is_refused() {
        for text in ["[".repeat(200_000), "{\"a\":".repeat(200_000)] {
            assert!(one_or_many::<serde_json::Value>(&text).is_err());
        }
        let value = "[".repeat(100) + &"]".repeat(100);
        assert!(one_or_many::<serde_json::Value>(&value).is_ok());
    }
}
