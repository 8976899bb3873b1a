//! The parser of expressions.

use std::sync::Arc;

use super::fault::XPathSyntaxFault;
use super::tokens::{TokenKind, XpathToken, tokens};
use super::{
    Axis, Comparison, Expr, Function, Join, LocationPath, NamespaceTest, Operator, PathIndex,
    Start, StepTest, XPathStep, XpathNamespaces,
};

/// Parses an expression.
///
/// # Errors
/// [`XPathSyntaxFault`].
pub(crate) fn parse(text: &str, namespaces: &XpathNamespaces) -> Result<Expr, XPathSyntaxFault> {
    if text.len() > MAX_LENGTH {
        return Err(XPathSyntaxFault::Length(MAX_LENGTH));
    }
    let mut parser = Parser {
        tokens: tokens(text)?,
        next: 0,
        depth: 0,
        operators: 0,
        namespaces,
    };
    let expr = parser.expr()?;
    match parser.tokens.get(parser.next) {
        None => Ok(expr),
        Some(token) => Err(XPathSyntaxFault::Unexpected {
            token: shown(&token.kind),
            position: token.position,
        }),
    }
}

struct Parser<'a> {
    tokens: Vec<XpathToken>,
    next: usize,
    depth: usize,
    operators: usize,
    namespaces: &'a XpathNamespaces,
}

type Parsed<T> = Result<T, XPathSyntaxFault>;

/// The binary operators by precedence, weakest first.
const LEVELS: [&[&str]; 7] = [
    &["or"],
    &["and"],
    &["=", "!="],
    &["<", "<=", ">", ">="],
    &["+", "-"],
    &["*", "div", "mod"],
    &["|"],
];
/// The level above which a sign may stand.
const UNARY: usize = 6;

impl Parser<'_> {
    fn expr(&mut self) -> Parsed<Expr> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(XPathSyntaxFault::Depth(MAX_DEPTH));
        }
        let expr = self.level(0);
        self.depth -= 1;
        expr
    }

    fn level(&mut self, level: usize) -> Parsed<Expr> {
        if level == UNARY && self.take("-") {
            self.depth += 1;
            if self.depth > MAX_DEPTH {
                return Err(XPathSyntaxFault::Depth(MAX_DEPTH));
            }
            let expr = self.level(UNARY)?;
            self.depth -= 1;
            return Ok(Expr::Negate(Box::new(expr)));
        }
        let Some(symbols) = LEVELS.get(level) else {
            return self.path();
        };
        let mut left = self.level(level + 1)?;
        while let Some(symbol) = symbols.iter().copied().find(|symbol| self.take(symbol)) {
            // The expression nests to the left, and is evaluated by recursion.
            self.operators += 1;
            if self.operators > MAX_OPERATORS {
                return Err(XPathSyntaxFault::Operators(MAX_OPERATORS));
            }
            let right = self.level(level + 1)?;
            left = binary(symbol, left, right);
        }
        Ok(left)
    }

    fn path(&mut self) -> Parsed<Expr> {
        let mut steps = Vec::new();
        let start = if self.take("//") {
            steps.push(any_descendant());
            self.steps(&mut steps)?;
            Start::Root
        } else if self.take("/") {
            if self.begins_step() {
                self.steps(&mut steps)?;
            }
            Start::Root
        } else if self.begins_step() {
            self.steps(&mut steps)?;
            Start::Context
        } else {
            let primary = self.primary()?;
            let mut predicates = Vec::new();
            while self.take("[") {
                predicates.push(self.predicate()?);
            }
            let continues = if self.take("//") {
                steps.push(any_descendant());
                true
            } else {
                self.take("/")
            };
            if continues {
                self.steps(&mut steps)?;
            } else if predicates.is_empty() {
                return Ok(primary);
            }
            Start::Filter(Box::new(primary), predicates)
        };
        let steps = shortened(steps);
        let index = match start {
            Start::Root => index(&steps),
            Start::Context | Start::Filter(..) => None,
        };
        Ok(Expr::Path(Box::new(LocationPath {
            start,
            steps,
            index,
        })))
    }

    fn steps(&mut self, steps: &mut Vec<XPathStep>) -> Parsed<()> {
        loop {
            if steps.len() >= MAX_DEPTH {
                return Err(XPathSyntaxFault::Steps(MAX_DEPTH));
            }
            let step = self.step()?;
            steps.push(step);
            if self.take("//") {
                steps.push(any_descendant());
            } else if !self.take("/") {
                return Ok(());
            }
        }
    }

    fn step(&mut self) -> Parsed<XPathStep> {
        for (symbol, axis) in [("..", Axis::Parent), (".", Axis::Itself)] {
            if self.take(symbol) {
                return Ok(XPathStep {
                    axis,
                    test: StepTest::Node,
                    predicates: Vec::new(),
                });
            }
        }
        let axis = self.axis()?;
        let test = self.test()?;
        let mut predicates = Vec::new();
        while self.take("[") {
            predicates.push(self.predicate()?);
        }
        Ok(XPathStep {
            axis,
            test,
            predicates,
        })
    }

    fn axis(&mut self) -> Parsed<Axis> {
        if self.take("@") {
            return Ok(Axis::Attribute);
        }
        let named = match (self.peek(0), self.peek(1)) {
            (Some(TokenKind::Name(None, name)), Some(TokenKind::Symbol("::"))) => name.clone(),
            _ => return Ok(Axis::Child),
        };
        self.next += 2;
        AXES.iter()
            .find(|(name, _)| *name == named)
            .map(|(_, axis)| *axis)
            .ok_or_else(|| {
                let known: Vec<&str> = AXES.iter().map(|(name, _)| *name).collect();
                XPathSyntaxFault::Axis {
                    known: known.join(", "),
                    name: named,
                }
            })
    }

    fn test(&mut self) -> Parsed<StepTest> {
        let Some(TokenKind::Name(prefix, local)) = self.peek(0).cloned() else {
            return Err(self.wrong("the name of an element or attribute"));
        };
        self.next += 1;
        if prefix.is_none() && self.take("(") {
            let target = match self.peek(0).cloned() {
                Some(TokenKind::Text(text)) if local == "processing-instruction" => {
                    self.next += 1;
                    Some(text)
                }
                _ => None,
            };
            self.expect(")")?;
            return match local.as_str() {
                "node" => Ok(StepTest::Node),
                "text" => Ok(StepTest::Text),
                "comment" => Ok(StepTest::Comment),
                "processing-instruction" => Ok(StepTest::Instruction(target)),
                _ => Err(XPathSyntaxFault::NodeTest(local)),
            };
        }
        let space = match prefix {
            None if local == "*" || self.namespaces.is_empty() => NamespaceTest::Any,
            None => NamespaceTest::None,
            Some(prefix) => {
                let declared = self.namespaces.iter().find(|(known, _)| *known == prefix);
                match declared {
                    Some((_, uri)) => NamespaceTest::Uri(uri.clone()),
                    None => NamespaceTest::OfDocument(prefix),
                }
            }
        };
        Ok(StepTest::Name(space, (local != "*").then_some(local)))
    }

    fn predicate(&mut self) -> Parsed<Expr> {
        let expr = self.expr()?;
        self.expect("]")?;
        Ok(expr)
    }

    fn primary(&mut self) -> Parsed<Expr> {
        if self.take("(") {
            let expr = self.expr()?;
            self.expect(")")?;
            return Ok(expr);
        }
        match self.peek(0).cloned() {
            Some(TokenKind::Text(text)) => {
                self.next += 1;
                Ok(Expr::Text(text))
            }
            Some(TokenKind::Number(number)) => {
                self.next += 1;
                Ok(Expr::Number(number))
            }
            Some(TokenKind::Name(prefix, name)) => {
                self.next += 2;
                self.call(prefix, &name)
            }
            Some(TokenKind::Symbol(_)) | None => Err(self.wrong("a path, a text or a number")),
        }
    }

    /// Parses the arguments of a function behind its bracket.
    fn call(&mut self, prefix: Option<String>, name: &str) -> Parsed<Expr> {
        // The functions of XPath 2 and later have the prefix `fn` in some mappings.
        let known = Function::ALL.iter().find(|(known, ..)| *known == name);
        let known = known.filter(|_| prefix.is_none_or(|prefix| prefix == "fn"));
        let Some((_, function, least, most)) = known.copied() else {
            let all: Vec<&str> = Function::ALL.iter().map(|(name, ..)| *name).collect();
            return Err(XPathSyntaxFault::Function {
                name: name.to_owned(),
                known: all.join(", "),
            });
        };
        let mut all = Vec::new();
        if !self.take(")") {
            loop {
                all.push(self.expr()?);
                if !self.take(",") {
                    break;
                }
            }
            self.expect(")")?;
        }
        if all.len() < least || all.len() > most {
            return Err(XPathSyntaxFault::Arguments {
                name: name.to_owned(),
                least,
                most,
                given: all.len(),
            });
        }
        Ok(Expr::Call(function, all))
    }

    /// Returns whether the next token begins a step, and not a function.
    fn begins_step(&self) -> bool {
        match (self.peek(0), self.peek(1)) {
            (Some(TokenKind::Symbol("@" | "." | "..")), _) => true,
            (Some(TokenKind::Name(None, name)), Some(TokenKind::Symbol("("))) => {
                ["node", "text", "comment", "processing-instruction"].contains(&name.as_str())
            }
            (Some(TokenKind::Name(Some(_), _)), Some(TokenKind::Symbol("("))) => false,
            (Some(TokenKind::Name(..)), _) => true,
            _ => false,
        }
    }

    fn peek(&self, ahead: usize) -> Option<&TokenKind> {
        self.tokens.get(self.next + ahead).map(|token| &token.kind)
    }

    fn take(&mut self, symbol: &str) -> bool {
        let found = matches!(self.peek(0), Some(TokenKind::Symbol(next)) if *next == symbol);
        self.next += usize::from(found);
        found
    }

    fn expect(&mut self, symbol: &str) -> Parsed<()> {
        if self.take(symbol) {
            Ok(())
        } else {
            Err(self.wrong(&format!("`{symbol}`")))
        }
    }

    fn wrong(&self, expected: &str) -> XPathSyntaxFault {
        let expected = expected.to_owned();
        match self.tokens.get(self.next) {
            Some(token) => XPathSyntaxFault::Expected {
                expected,
                token: shown(&token.kind),
                position: token.position,
            },
            None => XPathSyntaxFault::ExpectedAtEnd(expected),
        }
    }
}

fn binary(symbol: &str, left: Expr, right: Expr) -> Expr {
    let (left, right) = (Box::new(left), Box::new(right));
    match symbol {
        "or" => Expr::Or(left, right),
        "and" => Expr::And(left, right),
        "|" => Expr::Union(left, right),
        "=" => Expr::Compare(Comparison::Equal, left, right),
        "!=" => Expr::Compare(Comparison::NotEqual, left, right),
        "<" => Expr::Compare(Comparison::Less, left, right),
        "<=" => Expr::Compare(Comparison::LessOrEqual, left, right),
        ">" => Expr::Compare(Comparison::Greater, left, right),
        ">=" => Expr::Compare(Comparison::GreaterOrEqual, left, right),
        "+" => Expr::Calculate(Operator::Add, left, right),
        "-" => Expr::Calculate(Operator::Subtract, left, right),
        "*" => Expr::Calculate(Operator::Multiply, left, right),
        "div" => Expr::Calculate(Operator::Divide, left, right),
        _ => Expr::Calculate(Operator::Remainder, left, right),
    }
}

fn any_descendant() -> XPathStep {
    XPathStep {
        axis: Axis::DescendantOrSelf,
        test: StepTest::Node,
        predicates: Vec::new(),
    }
}

/// Splits predicates with `and`, and turns `//name` into one step. Both change no result, because
/// no predicate of such a step depends on a position.
fn shortened(steps: Vec<XPathStep>) -> Vec<XPathStep> {
    let mut all: Vec<XPathStep> = Vec::new();
    for mut step in steps {
        if !step.predicates.iter().any(Expr::is_positional) {
            step.predicates = step.predicates.into_iter().flat_map(conjuncts).collect();
            if step.axis == Axis::Child && all.last() == Some(&any_descendant()) {
                all.pop();
                step.axis = Axis::Descendant;
            }
        }
        all.push(step);
    }
    all
}

fn conjuncts(expr: Expr) -> Vec<Expr> {
    // A part of a conjunction may be a number, which is no position inside of it.
    if let Expr::And(a, b) = expr {
        if a.is_positional() || b.is_positional() {
            return vec![Expr::And(a, b)];
        }
        let mut all = conjuncts(*a);
        all.extend(conjuncts(*b));
        return all;
    }
    vec![expr]
}

/// Returns the index of an absolute path.
fn index(steps: &[XPathStep]) -> Option<PathIndex> {
    let fixed = steps.iter().take_while(|step| !step.has_current()).count();
    let leading = steps.get(..fixed)?;
    let key = format!("{leading:?}");
    let join = steps
        .get(fixed)
        .and_then(|step| join(&key, step))
        .map(Box::new);
    Some(PathIndex {
        key: key.into(),
        steps: fixed,
        join,
    })
}

fn join(before: &str, step: &XPathStep) -> Option<Join> {
    if step.predicates.iter().any(Expr::is_positional) {
        return None;
    }
    let is_candidate = |expr: &Expr| !expr.has_current() && !expr.is_outer() && expr.is_textual();
    let is_probe = |expr: &Expr| expr.is_outer() && expr.is_textual();
    let found = step.predicates.iter().enumerate().find_map(|(at, one)| {
        let Expr::Compare(Comparison::Equal, a, b) = one else {
            return None;
        };
        if is_candidate(a) && is_probe(b) {
            Some((at, a, b))
        } else if is_candidate(b) && is_probe(a) {
            Some((at, b, a))
        } else {
            None
        }
    });
    let (at, candidate, probe) = found?;
    let rest = step.predicates.iter().enumerate();
    let rest = rest.filter(|(other, _)| *other != at);
    let key = format!("{before}{:?}{:?}{candidate:?}", step.axis, step.test);
    Some(Join {
        key: Arc::from(key),
        candidate: Arc::new((**candidate).clone()),
        probe: Arc::new((**probe).clone()),
        rest: rest.map(|(_, one)| one.clone()).collect(),
    })
}

fn shown(kind: &TokenKind) -> String {
    match kind {
        TokenKind::Number(number) => format!("`{number}`"),
        TokenKind::Text(text) => format!("the text `{text}`"),
        TokenKind::Name(None, name) => format!("`{name}`"),
        TokenKind::Name(Some(prefix), name) => format!("`{prefix}:{name}`"),
        TokenKind::Symbol(symbol) => format!("`{symbol}`"),
    }
}

const AXES: [(&str, Axis); 12] = [
    ("ancestor", Axis::Ancestor),
    ("ancestor-or-self", Axis::AncestorOrSelf),
    ("attribute", Axis::Attribute),
    ("child", Axis::Child),
    ("descendant", Axis::Descendant),
    ("descendant-or-self", Axis::DescendantOrSelf),
    ("following", Axis::Following),
    ("following-sibling", Axis::FollowingSibling),
    ("parent", Axis::Parent),
    ("preceding", Axis::Preceding),
    ("preceding-sibling", Axis::PrecedingSibling),
    ("self", Axis::Itself),
];
const MAX_DEPTH: usize = 64;
const MAX_OPERATORS: usize = 256;
const MAX_LENGTH: usize = 16 << 10;

#[cfg(test)]
mod tests {
    use super::*;

    /// With a copy of the index in each outer one, these would have 2^40 steps.
    #[test]
    fn nested_indexes_are_read_at_once() {
        let mut plain = "/a".to_owned();
        let mut joined = "current()/x".to_owned();
        for _ in 0..40 {
            plain = format!("/a[{plain}]");
            joined = format!("/a[b={joined}]");
        }
        for text in [plain, joined] {
            let expr = parse(&text, &[]).unwrap();
            assert_eq!(expr, parse(&text, &[]).unwrap());
            assert!(format!("{expr:?}").len() < 40_000, "{text}");
        }
    }
}
