//! The tokens of an expression (XPath 1.0, 3.7).

use super::fault::{TokenFault, XPathSyntaxFault};

/// A token with the position of its first character, from 1.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct XpathToken {
    pub(super) kind: TokenKind,
    pub(super) position: usize,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum TokenKind {
    Number(f64),
    Text(String),
    /// A name, which may have a prefix. The local name may be `*`.
    Name(Option<String>, String),
    /// A symbol, or one of the operators `and`, `or`, `div` and `mod`.
    Symbol(&'static str),
}

/// The symbols, longer ones first.
const SYMBOLS: [&str; 21] = [
    "::", "//", "..", "!=", "<=", ">=", "(", ")", "[", "]", "@", ",", "/", "|", "+", "-", "=", "<",
    ">", ".", "$",
];

/// Splits an expression into tokens.
pub(super) fn tokens(text: &str) -> Result<Vec<XpathToken>, XPathSyntaxFault> {
    let mut all: Vec<XpathToken> = Vec::new();
    let mut rest = text;
    loop {
        rest = rest.trim_start();
        let Some(first) = rest.chars().next() else {
            return Ok(all);
        };
        let before = text.get(..text.len() - rest.len()).unwrap_or_default();
        let position = before.chars().count() + 1;
        let (kind, after) = one(rest, first, all.last().map(|token| &token.kind))
            .map_err(|fault| XPathSyntaxFault::Token { fault, position })?;
        all.push(XpathToken { kind, position });
        rest = after;
    }
}

fn one<'a>(
    rest: &'a str,
    first: char,
    before: Option<&TokenKind>,
) -> Result<(TokenKind, &'a str), TokenFault> {
    if let quote @ ('"' | '\'') = first {
        let inner = rest.get(1..).unwrap_or_default();
        let (text, after) = inner.split_once(quote).ok_or(TokenFault::Unclosed(quote))?;
        return Ok((TokenKind::Text(text.to_owned()), after));
    }
    let fraction = rest.strip_prefix('.').and_then(|rest| rest.chars().next());
    if first.is_ascii_digit() || fraction.is_some_and(|digit| digit.is_ascii_digit()) {
        let end = rest.find(|c: char| !c.is_ascii_digit() && c != '.');
        let (number, after) = rest.split_at(end.unwrap_or(rest.len()));
        let number = number
            .parse()
            .map_err(|_| TokenFault::Number(number.to_owned()))?;
        return Ok((TokenKind::Number(number), after));
    }
    if first == '*' {
        let after = rest.get(1..).unwrap_or_default();
        return Ok(if ends_operand(before) {
            (TokenKind::Symbol("*"), after)
        } else {
            (TokenKind::Name(None, "*".to_owned()), after)
        });
    }
    if let Some(symbol) = SYMBOLS.iter().find(|symbol| rest.starts_with(**symbol)) {
        if *symbol == "$" {
            return Err(TokenFault::Variable);
        }
        return Ok((
            TokenKind::Symbol(symbol),
            rest.get(symbol.len()..).unwrap_or_default(),
        ));
    }
    let (name, after) = name(rest).ok_or(TokenFault::Character(first))?;
    if ends_operand(before) {
        let operator = ["and", "or", "div", "mod"];
        let Some(operator) = operator.into_iter().find(|operator| *operator == name) else {
            return Err(TokenFault::NoOperator(name.to_owned()));
        };
        return Ok((TokenKind::Symbol(operator), after));
    }
    // A colon is part of the name unless the name is an axis.
    if let Some(local) = after
        .strip_prefix(':')
        .filter(|rest| !rest.starts_with(':'))
    {
        if let Some(after) = local.strip_prefix('*') {
            return Ok((
                TokenKind::Name(Some(name.to_owned()), "*".to_owned()),
                after,
            ));
        }
        let (local, after) =
            self::name(local).ok_or_else(|| TokenFault::NoLocalName(name.to_owned()))?;
        return Ok((
            TokenKind::Name(Some(name.to_owned()), local.to_owned()),
            after,
        ));
    }
    Ok((TokenKind::Name(None, name.to_owned()), after))
}

fn name(text: &str) -> Option<(&str, &str)> {
    let is_part = |c: char| c.is_alphanumeric() || matches!(c, '_' | '-' | '.' | '\u{b7}');
    let end = text.find(|c| !is_part(c)).unwrap_or(text.len());
    let starts = text.starts_with(|c: char| c.is_alphabetic() || c == '_');
    starts.then(|| text.split_at(end))
}

/// Returns whether an operator may follow.
fn ends_operand(before: Option<&TokenKind>) -> bool {
    match before {
        None => false,
        Some(TokenKind::Number(_) | TokenKind::Text(_) | TokenKind::Name(..)) => true,
        Some(TokenKind::Symbol(symbol)) => matches!(*symbol, ")" | "]" | "." | ".."),
    }
}
