//! Parses the value of `_name:=value` on a command line.
//!
//! If roscpp and rospy read a plain word differently, this module follows roscpp: `yes`, `on` and
//! `1:30` are text, `010` is ten and `1e3` a number, all of which the YAML 1.1 of rospy reads
//! otherwise. Only special numbers follow rospy: `.inf` and `.nan` are numbers, `inf` and `nan` are
//! text. Quotes, `[...]` and `{...}` are read as YAML, as rospy does. Invalid YAML is text.

use std::collections::BTreeMap;

use granit_parser::{Event, Parser, ScalarStyle};

use crate::parameters::{ParamError, ParamValue};

/// Parses the text after `:=`. Fails for an integer of more than 32 bits.
pub(crate) fn value(text: &str) -> Result<ParamValue, ParamError> {
    if text.starts_with(['[', '{', '"', '\'']) {
        let read = yaml(text)?;
        return Ok(read.unwrap_or_else(|| text.into()));
    }
    plain(text)
}

/// Parses YAML. Returns `None` for invalid YAML and for YAML with other constructs than values.
fn yaml(text: &str) -> Result<Option<ParamValue>, ParamError> {
    let options = granit_parser::options! {
        emit_comments: false,
        flow_nesting_limit: MAX_DEPTH,
        block_nesting_limit: MAX_DEPTH
    };
    let mut open: Vec<Open> = Vec::new();
    let mut root = None;
    for event in Parser::new_from_str_with_options(text, options) {
        let Ok((event, _)) = event else {
            return Ok(None);
        };
        if event.tag().is_some() || (root.is_some() && matches!(event, Event::DocumentStart(..))) {
            return Ok(None);
        }
        let done = match event {
            Event::Scalar(text, ScalarStyle::Plain, ..) => plain(&text)?,
            Event::Scalar(text, ..) => ParamValue::String(text.into_owned()),
            Event::SequenceStart(..) => {
                open.push(Open::List(Vec::new()));
                continue;
            }
            Event::MappingStart(..) => {
                open.push(Open::Map(BTreeMap::new(), None));
                continue;
            }
            Event::SequenceEnd | Event::MappingEnd => match open.pop() {
                Some(Open::List(items)) => ParamValue::List(items),
                Some(Open::Map(members, _)) => ParamValue::Map(members),
                None => return Ok(None),
            },
            Event::StreamStart
            | Event::StreamEnd
            | Event::DocumentStart(..)
            | Event::DocumentEnd => continue,
            // The enumeration is open: an unknown event is not a simple value.
            Event::Alias(_) | Event::UnresolvedAlias(_) | Event::Anchor(..) | _ => return Ok(None),
        };
        match open.last_mut() {
            None => root = Some(done),
            Some(parent) => {
                if parent.take(done).is_none() {
                    return Ok(None);
                }
            }
        }
    }
    Ok(root)
}

/// A list or map that is not complete yet.
enum Open {
    List(Vec<ParamValue>),
    /// The members, and a name that waits for its value.
    Map(BTreeMap<String, ParamValue>, Option<String>),
}

impl Open {
    /// Adds a value. Returns `None` if the name of a member is not text, which the parameter server
    /// does not support.
    fn take(&mut self, value: ParamValue) -> Option<()> {
        match self {
            Self::List(items) => items.push(value),
            Self::Map(members, name) => match name.take() {
                Some(name) => {
                    members.insert(name, value);
                }
                None => *name = Some(value.as_str()?.to_owned()),
            },
        }
        Some(())
    }
}

fn plain(text: &str) -> Result<ParamValue, ParamError> {
    let digits = text.strip_prefix(['+', '-']).unwrap_or(text);
    let numeric = digits.starts_with(|c: char| c.is_ascii_digit() || c == '.');
    let special = match text {
        "true" | "True" | "TRUE" => Some(true.into()),
        "false" | "False" | "FALSE" => Some(false.into()),
        ".nan" | ".NaN" | ".NAN" => Some(f64::NAN.into()),
        _ => match digits {
            ".inf" | ".Inf" | ".INF" if text.starts_with('-') => Some(f64::NEG_INFINITY.into()),
            ".inf" | ".Inf" | ".INF" => Some(f64::INFINITY.into()),
            _ => None,
        },
    };
    if let Some(value) = special {
        return Ok(value);
    }
    if !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit()) {
        let number = text.parse().map(ParamValue::Int);
        return number.map_err(|_| ParamError::IntRange(text.to_owned()));
    }
    match text.parse() {
        Ok(number) if numeric => Ok(ParamValue::Double(number)),
        _ => Ok(text.into()),
    }
}

/// Same limit as for XML-RPC documents.
const MAX_DEPTH: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plain_word_is_what_roscpp_reads() {
        for (text, meant) in [
            ("5", ParamValue::Int(5)),
            ("-7", ParamValue::Int(-7)),
            ("010", ParamValue::Int(10)),
            ("0.5", ParamValue::Double(0.5)),
            ("1e3", ParamValue::Double(1000.0)),
            ("-1e3", ParamValue::Double(-1000.0)),
            (".5", ParamValue::Double(0.5)),
            ("-.inf", ParamValue::Double(f64::NEG_INFINITY)),
            ("true", ParamValue::Bool(true)),
            ("False", ParamValue::Bool(false)),
            ("yes", "yes".into()),
            ("inf", "inf".into()),
            ("infinity", "infinity".into()),
            ("", "".into()),
            ("-", "-".into()),
            (".", ".".into()),
            ("1:30", "1:30".into()),
            ("10.0.0.7", "10.0.0.7".into()),
            ("/dev/ttyUSB0", "/dev/ttyUSB0".into()),
            ("a: b", "a: b".into()),
        ] {
            assert_eq!(value(text).unwrap(), meant, "{text}");
        }
        assert!(value(".nan").unwrap().as_double().unwrap().is_nan());
    }

    #[test]
    fn quotes_lists_and_maps_are_yaml() {
        assert_eq!(value("'5'").unwrap(), "5".into());
        assert_eq!(
            value("[1, 2.5, [true, 'a']]").unwrap(),
            ParamValue::List(vec![
                1.into(),
                2.5.into(),
                ParamValue::List(vec![true.into(), "a".into()])
            ])
        );
        assert_eq!(
            value("{p: 0.1, limits: {low: -1}}").unwrap(),
            [
                ("p", ParamValue::from(0.1)),
                ("limits", [("low", -1)].into())
            ]
            .into()
        );
        assert_eq!(value("{}").unwrap(), ParamValue::Map(BTreeMap::new()));
    }

    #[test]
    fn what_is_no_yaml_is_text() {
        for text in [
            "[1",
            "{a",
            "{1: 2}",
            "[*a]",
            "[!!int 5]",
            "[1] [2]",
            "'a' b",
        ] {
            assert_eq!(value(text).unwrap(), text.into(), "{text}");
        }
        let deep = "[".repeat(10_000);
        assert_eq!(value(&deep).unwrap(), deep.as_str().into());
    }

    #[test]
    fn an_integer_past_32_bits_is_refused() {
        for text in ["2147483648", "[1, -2147483649]"] {
            assert!(
                matches!(value(text), Err(ParamError::IntRange(_))),
                "{text}"
            );
        }
        assert_eq!(value("2147483648.0").unwrap(), 2_147_483_648.0.into());
    }
}
