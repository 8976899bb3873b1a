//! Passwords in URLs, as `opc.tcp://user:password@host`.

use std::borrow::Cow;
use std::ops::Range;

/// Whether a text as it stands in a file has a password in it. One that is a variable of the environment is not in it.
pub(crate) fn is_written(text: &str) -> bool {
    // Of most there is none, which is quicker to see by bytes.
    text.as_bytes().contains(&b'@') && passwords(text, at_sign).next().is_some()
}

/// Whether a user name, with a password or without, stands before the host of a URL.
pub(crate) fn has_user(url: &str) -> bool {
    users(url, at_sign).next().is_some()
}

/// A line without its passwords, as many characters as it had.
pub(crate) fn masked(text: &str) -> Cow<'_, str> {
    let of_urls = starred(text, passwords(text, at_sign));
    match key(&of_urls) {
        Some(at) => Cow::Owned(starred(&of_urls, std::iter::once(at)).into_owned()),
        None => of_urls,
    }
}

/// Where the value of the key `password` stands in a line, if it stands in the file itself.
fn key(line: &str) -> Option<Range<usize>> {
    let (before, behind) = line.split_once(KEY)?;
    let value = behind.trim_start();
    let start = before.len() + KEY.len() + (behind.len() - value.len());
    let quoted = value.chars().next().filter(|c| matches!(c, '"' | '\''));
    let length = match quoted {
        // Up to the end where the quote is not closed in the line.
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

/// A text that may have been cut, without its passwords: before `...` the beginning of one may stand.
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

/// Where the passwords of the URLs in a text stand. For `last` see [`users`].
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

/// Whether a text is `${NAME}`, or several of them, and nothing else. A default is as readable as what stands there
/// without a variable.
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

/// Where users and their passwords stand: between `://` and the `@` before the host. `last` finds the last `@`, or what
/// may have been one, in a text without spaces and quotes.
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
            // What stands within one begins no other.
            if start < next {
                return None;
            }
            next = start + user(run.get(start..end?)?)?;
            Some(from + start..from + next)
        })
    })
}

/// How many bytes of `rest` are user and password; `None` when it is the beginning of a host with a path. `rest` is what
/// stands behind `://` and before the last `@`.
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
        // A password may have a slash in it, written as a URL should not be.
        (_, Some(_)) => Some(rest.len()),
    }
}

/// Where the colon behind the user or the host stands: not that of a default, nor one of an IPv6 address.
fn colon(authority: &str) -> Option<usize> {
    let host = match authority.starts_with('[') {
        true => authority.find(']').unwrap_or(0),
        false => 0,
    };
    Some(host + outside(authority.get(host..)?, |c| c == ':')?)
}

fn is_port(text: &str) -> bool {
    let digits = |text: &str| text.bytes().all(|b| b.is_ascii_digit());
    let default = text
        .strip_prefix("${")
        .and_then(|of| of.strip_suffix('}')?.split_once(":-"));
    // The URL may be the default of a variable itself.
    digits(text.trim_end_matches('}'))
        || is_variable(text)
        || default.is_some_and(|(_, default)| digits(default))
}

/// Where the first such character stands that is in no `${NAME:-default}`.
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

/// Whether a URL in a text ends before it.
fn is_end(c: char) -> bool {
    matches!(c, '"' | '\'' | '`') || c.is_whitespace()
}

fn at_sign(run: &str) -> Option<usize> {
    run.rfind('@')
}

/// So many bytes of a variable with its default are looked at.
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
