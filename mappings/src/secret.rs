//! Passwords in URLs, as `opc.tcp://user:password@host`.

use std::borrow::Cow;
use std::ops::Range;

/// Whether a text as it stands in a file has a password in it. One that is a variable of the environment is not in it.
pub(crate) fn is_written(text: &str) -> bool {
    // Of most there is none, which is quicker to see by bytes.
    text.as_bytes().contains(&b'@') && passwords(text).next().is_some()
}

/// Whether a user name, with a password or without, stands before the host of a URL.
pub(crate) fn has_user(url: &str) -> bool {
    authorities(url).any(|at| url.get(at).is_some_and(|authority| authority.contains('@')))
}

/// A text without its passwords, as many characters as it had.
pub(crate) fn masked(text: &str) -> Cow<'_, str> {
    let mut out = String::new();
    let mut done = 0;
    for at in passwords(text) {
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

/// Where the passwords of the URLs in a text stand.
fn passwords(text: &str) -> impl Iterator<Item = Range<usize>> {
    authorities(text).filter_map(|at| {
        let authority = text.get(at.clone())?;
        let (user_info, _) = authority.rsplit_once('@')?;
        let (user, password) = user_info.split_once(':')?;
        let start = at.start + user.len() + 1;
        let there = !password.is_empty() && !is_variable(password);
        there.then(|| start..start + password.len())
    })
}

/// Whether a text is `${NAME}` alone. A default is as readable as what stands there without a variable.
fn is_variable(text: &str) -> bool {
    let inside = text
        .strip_prefix("${")
        .and_then(|rest| rest.strip_suffix('}'));
    inside.is_some_and(|inside| {
        inside
            .split_once(":-")
            .is_none_or(|(_, default)| default.is_empty())
    })
}

/// Where users, passwords and hosts of the URLs in a text stand: behind `://`, up to a slash or what ends a URL.
fn authorities(text: &str) -> impl Iterator<Item = Range<usize>> {
    let starts = text.match_indices("://").map(|(at, mark)| at + mark.len());
    starts.map(|start| {
        let rest = text.get(start..).unwrap_or_default();
        let ends = |c: char| matches!(c, '/' | '?' | '#' | '"' | '\'' | '`') || c.is_whitespace();
        start..start + rest.find(ends).unwrap_or(rest.len())
    })
}

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
            "",
            "://",
        ] {
            assert_eq!(masked(text), text);
            assert!(!is_written(text), "{text}");
        }
        assert!(has_user("opc.tcp://me@host") && !has_user("opc.tcp://host/@"));
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
        ] {
            assert_eq!(is_written(text), written, "{text}");
        }
    }
}
