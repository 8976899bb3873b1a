//! Functions and comparisons of texts and numbers (XPath 1.0, 3.4 and 4).

use std::collections::{HashMap, HashSet};

use super::Comparison;
use super::fault::{Evaluated, EvaluationFault};

pub(super) fn holds<T: PartialOrd>(comparison: Comparison, a: &T, b: &T) -> bool {
    match comparison {
        Comparison::Equal => a == b,
        Comparison::NotEqual => a != b,
        Comparison::Less => a < b,
        Comparison::LessOrEqual => a <= b,
        Comparison::Greater => a > b,
        Comparison::GreaterOrEqual => a >= b,
    }
}

/// Returns whether a pair of values compares so, in linear time.
pub(super) fn any_pair(comparison: Comparison, a: &[String], b: &[String]) -> bool {
    match comparison {
        Comparison::Equal => {
            let known: HashSet<&String> = a.iter().collect();
            b.iter().any(|text| known.contains(text))
        }
        Comparison::NotEqual => {
            let mut all = a.iter().chain(b);
            let first = all.next();
            !a.is_empty() && !b.is_empty() && all.any(|text| Some(text) != first)
        }
        Comparison::Less
        | Comparison::LessOrEqual
        | Comparison::Greater
        | Comparison::GreaterOrEqual => {
            let ascends = matches!(comparison, Comparison::Less | Comparison::LessOrEqual);
            let extreme = |texts: &[String], least: bool| {
                let numbers = texts.iter().map(|text| to_number(text));
                numbers.filter(|number| !number.is_nan()).reduce(if least {
                    f64::min
                } else {
                    f64::max
                })
            };
            match (extreme(a, ascends), extreme(b, !ascends)) {
                (Some(a), Some(b)) => holds(comparison, &a, &b),
                _ => false,
            }
        }
    }
}

/// Returns the characters at positions in the range (XPath 1.0, 4.2).
pub(super) fn substring(text: &str, start: f64, length: Option<f64>) -> String {
    let first = round(start);
    let end = length.map_or(f64::INFINITY, |length| first + round(length));
    let places = (1_u32..).map(f64::from);
    text.chars()
        .zip(places)
        .filter(|(_, place)| *place >= first && *place < end)
        .map(|(character, _)| character)
        .collect()
}

pub(super) fn translated(text: &str, from: &str, to: &str) -> String {
    let mut table: HashMap<char, Option<char>> = HashMap::new();
    let mut replacements = to.chars();
    for character in from.chars() {
        let replacement = replacements.next();
        table.entry(character).or_insert(replacement);
    }
    text.chars()
        .filter_map(|character| table.get(&character).copied().unwrap_or(Some(character)))
        .collect()
}

/// Rounds half up, as XPath does.
pub(super) fn round(number: f64) -> f64 {
    (number + 0.5).floor()
}

pub(super) fn count(number: usize) -> f64 {
    u32::try_from(number).map_or(f64::INFINITY, f64::from)
}

pub(super) fn to_number(text: &str) -> f64 {
    let text = text.trim();
    let is_number = |c: char| c.is_ascii_digit() || c == '.' || c == '-';
    if text.chars().all(is_number) {
        text.parse().unwrap_or(f64::NAN)
    } else {
        f64::NAN
    }
}

pub(super) fn of_number(number: f64) -> String {
    if number.is_infinite() {
        return if number > 0.0 {
            "Infinity"
        } else {
            "-Infinity"
        }
        .to_owned();
    }
    // Negative zero is written without its sign.
    (number + 0.0).to_string()
}

pub(super) fn bounded(text: String) -> Evaluated<String> {
    if text.len() > MAX_TEXT {
        Err(EvaluationFault::Text(MAX_TEXT))
    } else {
        Ok(text)
    }
}

const MAX_TEXT: usize = 16 << 20;
