//! The reasons why a text is no expression, and why an expression has no value.

/// Reason for which an expression has no value.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum EvaluationFault {
    #[error(
        "the mapping reads more than {0} nodes and bytes; narrow its paths, for example `/a/b` \
         instead of `//b`"
    )]
    Work(u64),
    #[error("the iterator is no path")]
    Iterator,
    #[error("a path was expected, and not a text, number or truth value")]
    NoPath,
    #[error("a value has more than {0} bytes")]
    Text(usize),
    #[error(
        "the prefix `{0}` is declared neither by rml:namespace of the reference formulation, nor \
         by the root element of the file"
    )]
    Prefix(String),
}

pub(crate) type Evaluated<T> = Result<T, EvaluationFault>;

/// Reason for which a text is no expression, with the position and the remedy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum XPathSyntaxFault {
    #[error("it has more than {0} bytes")]
    Length(usize),
    #[error("{fault} at character {position}")]
    Token { fault: TokenFault, position: usize },
    #[error("unexpected {token} at character {position}")]
    Unexpected { token: String, position: usize },
    #[error("expected {expected}, and found {token} at character {position}")]
    Expected {
        expected: String,
        token: String,
        position: usize,
    },
    #[error("expected {0} at the end")]
    ExpectedAtEnd(String),
    #[error("it nests more than {0} deep")]
    Depth(usize),
    #[error("it has more than {0} operators")]
    Operators(usize),
    #[error("the path has more than {0} steps")]
    Steps(usize),
    #[error("unknown axis `{name}`; known are {known}")]
    Axis { name: String, known: String },
    #[error("`{0}(..)` is not a test of a node; a function can only start a path")]
    NodeTest(String),
    #[error("unknown function `{name}`; known are {known}")]
    Function { name: String, known: String },
    #[error("`{name}` takes from {least} to {most} arguments, and has {given}")]
    Arguments {
        name: String,
        least: usize,
        most: usize,
        given: usize,
    },
}

/// A part of an expression that is no token.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum TokenFault {
    #[error("the text has no closing {0}")]
    Unclosed(char),
    #[error("`{0}` is not a number")]
    Number(String),
    #[error("variables are not supported; write the value")]
    Variable,
    #[error("unexpected character `{0}`")]
    Character(char),
    #[error("an operator is missing before `{0}`")]
    NoOperator(String),
    #[error("no name follows the prefix `{0}`")]
    NoLocalName(String),
}
