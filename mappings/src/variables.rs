//! Environment variables in a scalar.

/// Returns a text with the values of its variables, and each value with its reference in the text.
/// `lookup` returns `None` for a variable that is not set.
///
/// # Errors
/// The fault and its remedy.
pub(crate) fn expand(text: &str, lookup: &dyn Fn(&str) -> Option<String>) -> Expanded {
    let mut out = String::with_capacity(text.len());
    let mut values = Vec::new();
    let mut rest = text;
    while let Some((before, behind)) = rest.split_once("${") {
        if let Some(before) = before.strip_suffix('$') {
            out.push_str(before);
            out.push_str("${");
            rest = behind;
            continue;
        }
        out.push_str(before);
        let Some((inside, behind)) = behind.split_once('}') else {
            return Err((
                "`${` has no closing `}`".to_owned(),
                "write `$${` for the text `${`",
            ));
        };
        let (name, default) = match inside.split_once(":-") {
            Some((name, default)) => (name, Some(default)),
            None => (inside, None),
        };
        if !is_name(name) {
            let message = format!("`${{{inside}}}` is not an environment variable");
            return Err((
                message,
                "a name has letters, digits and underscores: ${ROBOT_1}, ${ROBOT_1:-arm}",
            ));
        }
        let set = lookup(name).filter(|value| default.is_none() || !value.is_empty());
        match (set, default) {
            (Some(value), _) => {
                out.push_str(&value);
                values.push((value, format!("${{{inside}}}")));
            }
            (None, Some(default)) => out.push_str(default),
            (None, None) => {
                return Err((
                    format!("the environment variable `{name}` is not set"),
                    "set it for the program, or give a default such as ${NAME:-default}",
                ));
            }
        }
        rest = behind;
        if out.len() > MOST {
            return Err((
                format!("its value is longer than {MOST} bytes"),
                "use a short text",
            ));
        }
    }
    out.push_str(rest);
    Ok((out, values))
}

/// The text with its values, or message and help.
type Expanded = Result<(String, Vec<(String, String)>), (String, &'static str)>;

pub(crate) fn is_name(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
        && name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
}

/// Maximum length of an expanded text, in bytes; no value of a mapping is that long.
const MOST: usize = 1 << 16;

#[cfg(test)]
mod tests {
    use super::*;

    fn with(text: &str) -> Result<String, String> {
        let lookup = |name: &str| match name {
            "ROBOT" => Some("arm".to_owned()),
            "EMPTY" => Some(String::new()),
            _ => None,
        };
        expand(text, &lookup)
            .map(|(text, _)| text)
            .map_err(|(message, _)| message)
    }

    #[test]
    fn variables_are_put_in_their_places() {
        for (text, expected) in [
            ("/${ROBOT}/pose", "/arm/pose"),
            ("${ROBOT}${ROBOT:-x}", "armarm"),
            ("${NONE:-}", ""),
            ("${EMPTY}", ""),
            ("${EMPTY:-leg}", "leg"),
            ("${NONE:-opc.udp://1.2.3.4}", "opc.udp://1.2.3.4"),
            ("$${ROBOT} costs 5$", "${ROBOT} costs 5$"),
            ("$$${ROBOT}", "$${ROBOT}"),
        ] {
            assert_eq!(with(text), Ok(expected.to_owned()), "{text}");
        }
    }

    #[test]
    fn what_is_no_variable_is_named() {
        assert!(with("${NONE}").unwrap_err().contains("`NONE` is not set"));
        for (text, word) in [
            ("${ROBOT", "has no closing"),
            ("${}", "`${}`"),
            ("${1A}", "is not an environment variable"),
            ("${A B:-x}", "is not an environment variable"),
        ] {
            assert!(with(text).unwrap_err().contains(word), "{text}");
        }
    }
}
