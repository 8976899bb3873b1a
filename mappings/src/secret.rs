//! Passwords in URLs, such as `opc.tcp://user:password@host`.

use std::borrow::Cow;
use std::ops::Range;

/// Returns `true` if the text of a file contains a password. A password from an environment
/// variable does not count.
pub(crate) fn is_written(text: &str) -> bool {
    // Most texts contain none, and a search by bytes is faster.
    text.as_bytes().contains(&b'@') && passwords(text, at_sign).next().is_some()
}

/// Returns `true` if a user name, with or without a password, precedes the host of a URL.
pub(crate) fn has_user(url: &str) -> bool {
    users(url, at_sign).next().is_some()
}

/// Masks the passwords of a line, with as many characters as before.
pub fn masked(text: &str) -> Cow<'_, str> {
    let of_urls = starred(text, passwords(text, at_sign));
    match key(&of_urls) {
        Some(at) => Cow::Owned(starred(&of_urls, std::iter::once(at)).into_owned()),
        None => of_urls,
    }
}

/// Returns the range of the value of the key `password` in a line, if the file itself contains the
/// value.
fn key(line: &str) -> Option<Range<usize>> {
    let (before, behind) = line.split_once(KEY)?;
    let value = behind.trim_start();
    let start = before.len() + KEY.len() + (behind.len() - value.len());
    let quoted = value.chars().next().filter(|c| matches!(c, '"' | '\''));
    let length = match quoted {
        // If the quote is not closed in the line, the value ends with the line.
        Some(quote) => value
            .get(1..)
            .and_then(|rest| rest.find(quote))
            .map_or(value.len(), |at| at + 2),
        None => {
            let mut variables = 0;
            while let Some(rest) = value.get(variables..)
                && rest.starts_with("${")
                && let Some(end) = rest.find('}')
            {
                variables += end + 1;
            }
            let rest = value.get(variables..)?;
            variables + rest.find([',', '}', '#']).unwrap_or(rest.len())
        }
    };
    let value = value.get(..length)?.trim_end();
    let there = !value.is_empty() && !is_variable(value.trim_matches(['"', '\'']));
    there.then_some(start..start + value.len())
}

const KEY: &str = "password:";

/// Masks the passwords of a text that may have been cut: the beginning of a password may precede
/// `...`.
pub(crate) fn masked_where_cut(text: &str) -> Cow<'_, str> {
    let last = |run: &str| run.rfind('@').max(run.rfind("..."));
    starred(text, passwords(text, last))
}

fn starred(text: &str, passwords: impl Iterator<Item = Range<usize>>) -> Cow<'_, str> {
    let mut out = String::new();
    let mut done = 0;
    for at in passwords {
        out.push_str(text.get(done..at.start).unwrap_or_default());
        let hidden = text.get(at.clone()).unwrap_or_default();
        out.extend(hidden.chars().map(|_| '*'));
        done = at.end;
    }
    if done == 0 {
        return Cow::Borrowed(text);
    }
    out.push_str(text.get(done..).unwrap_or_default());
    Cow::Owned(out)
}

/// Returns the ranges of the passwords in the URLs of a text. For `last` see [`users`].
fn passwords(
    text: &str,
    last: impl Fn(&str) -> Option<usize>,
) -> impl Iterator<Item = Range<usize>> {
    users(text, last).filter_map(move |at| {
        let start = at.start + colon(text.get(at.clone())?)? + 1;
        let password = text.get(start..at.end)?;
        let there = !password.is_empty() && !is_variable(password);
        there.then_some(start..at.end)
    })
}

/// Returns `true` for a text that is only `${NAME}`, or several of them. A variable with a default
/// does not count, because the default is in clear.
fn is_variable(text: &str) -> bool {
    let mut rest = text;
    while let Some((inside, behind)) = rest.strip_prefix("${").and_then(|of| of.split_once('}')) {
        if inside
            .split_once(":-")
            .is_some_and(|(_, default)| !default.is_empty())
        {
            return false;
        }
        rest = behind;
    }
    rest.is_empty() && !text.is_empty()
}

/// Returns the ranges of users and their passwords: between `://` and the `@` before the host.
/// `last` finds the last `@`, or the end of a cut text, in a text without spaces and quotes.
fn users(text: &str, last: impl Fn(&str) -> Option<usize>) -> impl Iterator<Item = Range<usize>> {
    let mut from = 0;
    let runs = text.split_inclusive(is_end).map(move |run| {
        let start = from;
        from += run.len();
        (start, run.trim_end_matches(is_end))
    });
    runs.flat_map(move |(from, run)| {
        let end = last(run);
        let mut next = 0;
        run.match_indices("://").filter_map(move |(at, mark)| {
            let start = at + mark.len();
            // A `://` inside of a range that was found begins no other range.
            if start < next {
                return None;
            }
            next = start + user(run.get(start..end?)?)?;
            Some(from + start..from + next)
        })
    })
}

/// Returns the length in bytes of user and password in `rest`; `None` if `rest` is the beginning of
/// a host with a path. `rest` is the text after `://` and before the last `@`.
fn user(rest: &str) -> Option<usize> {
    let Some(end) = outside(rest, |c| matches!(c, '/' | '?' | '#')) else {
        return Some(rest.len());
    };
    let authority = rest.get(..end)?;
    let near = authority.rfind('@');
    let host = near.unwrap_or(end);
    let password = colon(authority).and_then(|colon| authority.get(colon + 1..host));
    match (near, password) {
        (_, None) => near,
        (Some(_), Some(password)) if password.is_empty() || is_variable(password) => near,
        (None, Some(port)) if is_port(port) => None,
        // A password may contain a slash, although a URL should not contain it in this form.
        (_, Some(_)) => Some(rest.len()),
    }
}

/// Returns the position of the colon after the user or the host; colons of a default and of an IPv6
/// address do not count.
fn colon(authority: &str) -> Option<usize> {
    let host = if authority.starts_with('[') {
        authority.find(']').unwrap_or(0)
    } else {
        0
    };
    Some(host + outside(authority.get(host..)?, |c| c == ':')?)
}

fn is_port(text: &str) -> bool {
    let digits = |text: &str| text.bytes().all(|b| b.is_ascii_digit());
    let default = text
        .strip_prefix("${")
        .and_then(|of| of.strip_suffix('}')?.split_once(":-"));
    // The URL may itself be the default of a variable.
    digits(text.trim_end_matches('}'))
        || is_variable(text)
        || default.is_some_and(|(_, default)| digits(default))
}

/// Returns the position of the first such character outside of every `${NAME:-default}`.
fn outside(text: &str, wanted: impl Fn(char) -> bool) -> Option<usize> {
    let mut inside = 0;
    text.char_indices()
        .find(|(at, c)| {
            let rest = text.get(*at..).unwrap_or_default();
            if *at >= inside && rest.starts_with("${") {
                let end = rest.bytes().take(LONGEST).position(|b| b == b'}');
                inside = end.map_or(inside, |end| at + end);
            }
            *at >= inside && wanted(*c)
        })
        .map(|(at, _)| at)
}

/// Returns `true` for a character that ends a URL in a text.
fn is_end(c: char) -> bool {
    matches!(c, '"' | '\'' | '`') || c.is_whitespace()
}

fn at_sign(run: &str) -> Option<usize> {
    run.rfind('@')
}

/// Longest variable with its default, in bytes, that is recognized.
const LONGEST: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_password_is_hidden_and_all_else_stays_in_its_place() {
        for (text, told) in [
            (
                "opc.tcp://me:secret@host:4840/ua",
                "opc.tcp://me:******@host:4840/ua",
            ),
            ("http://me:a@b:c@host", "http://me:*****@host"),
            (
                "x: {a: rtsp://:pä@h, b: http://u:p@g} # c",
                "x: {a: rtsp://:**@h, b: http://u:*@g} # c",
            ),
            ("`http://me:secret@host`", "`http://me:******@host`"),
            (
                "opc.tcp://robot:aB/3x=@gateway:4840",
                "opc.tcp://robot:******@gateway:4840",
            ),
            ("http://me:a?b#c@host/x", "http://me:*****@host/x"),
            ("[http://u:p@g,http://u:q@h]", "[http://u:**************@h]"),
            ("http://me:a/b://u:c@h", "http://me:*********@h"),
        ] {
            assert_eq!(masked(text), told);
            assert_eq!(masked(text).chars().count(), text.chars().count());
            assert!(is_written(text) && has_user(text), "{text}");
        }
        for text in [
            "opc.tcp://host:4840/a@b:c",
            "http://host:80/ mail me:a@b",
            "http://me:@host",
            "me:secret@host",
            "http://host:/a@b",
            "opc.udp://[ff02::1]:4840/a@b",
            "http://host:4840/?mail=me:a@b",
            "http://${HOST:-gateway}:${PORT:-80}/a@b",
            "${URL:-http://host:80}/a@b",
            "",
            "://",
        ] {
            assert_eq!(masked(text), text);
            assert!(!is_written(text), "{text}");
        }
        assert!(has_user("opc.tcp://me@host") && !has_user("opc.tcp://host/@"));
    }

    #[test]
    fn the_password_of_a_user_is_hidden_where_it_stands_in_the_file() {
        for (line, told) in [
            ("    password: hunter2", "    password: *******"),
            (
                "  - {name: plc, password: hunter2, user: cell}",
                "  - {name: plc, password: *******, user: cell}",
            ),
            (r#"password: "a, b" # c"#, r#"password: ****** # c"#),
            ("password: 'open", "password: *****"),
        ] {
            assert_eq!(masked(line), told);
        }
        for line in [
            "password: ${PLC_PASSWORD}",
            "password:",
            "password: \"${X}\"",
        ] {
            assert_eq!(masked(line), line);
        }
    }

    #[test]
    fn a_password_of_the_environment_is_not_in_the_file_but_its_default_is() {
        for (text, written) in [
            ("http://me:${PASSWORD}@host", false),
            ("http://me:${PASSWORD:-}@host", false),
            ("http://me:${PASSWORD:-secret}@host", true),
            ("http://me:x${PASSWORD}@host", true),
            ("${URL:-http://me:secret@host}", true),
            ("${URL}", false),
            ("rtsp://${CAM_USER:-admin}@cam", false),
            ("rtsp://${CAM_USER:-admin}:${CAM_PW}@cam", false),
            ("rtsp://${CAM_USER:-admin}:sesame@cam", true),
            ("http://me:${A}${B}@h", false),
            ("http://me:${A}secret${B}@h", true),
            ("http://me:${PASSWORD}@host/a@b", false),
            ("http://me:a/${PASSWORD}@host", true),
        ] {
            assert_eq!(is_written(text), written, "{text}");
        }
        assert!(has_user("rtsp://${CAM_USER:-admin}@cam") && has_user("http://me:a/b@h"));
    }

    #[test]
    fn a_password_that_was_cut_is_hidden_as_far_as_it_stands_there() {
        for (text, told) in [
            ("`http://me:sec...` is none", "`http://me:***...` is none"),
            ("http://me:a@b/c... is none", "http://me:*****... is none"),
            ("http://me:a@b c...", "http://me:*@b c..."),
            ("http://host:80/a...", "http://host:80/a..."),
            ("http://me:${PW}@host/a...", "http://me:${PW}@host/a..."),
            ("http://host/me:a...", "http://host/me:a..."),
        ] {
            assert_eq!(masked_where_cut(text), told);
        }
    }
}
