//! Limits of queries that can be checked before the query runs.
//!
//! The evaluator checks for cancellation whenever it reads a statement. This module limits
//! operations that take time or memory without reading statements. Examples are joins of tables in
//! the query (`VALUES`), texts concatenated from themselves, and enough patterns to keep the
//! optimizer busy for minutes. Queries with `SERVICE`, which would call another server, are
//! refused.

use spargebra::Query;
use spargebra::algebra::{
    AggregateExpression, Expression, Function, GraphPattern, OrderExpression,
    PropertyPathExpression,
};

use crate::query::QueryFault;

/// Checks that the nesting of the text is within the limit for the parser. Brackets in texts and
/// IRIs count too.
pub(crate) fn nests(query: &str) -> Result<(), QueryFault> {
    let mut depth = 0_usize;
    for byte in query.bytes() {
        match byte {
            b'(' | b'{' | b'[' => depth += 1,
            b')' | b'}' | b']' => depth = depth.saturating_sub(1),
            _ => {}
        }
        if depth > MAX_DEPTH {
            return Err(QueryFault::TooComplex(format!(
                "it has more than {MAX_DEPTH} brackets inside each other"
            )));
        }
    }
    Ok(())
}

/// Checks whether the query may run.
pub(crate) fn check(query: &Query) -> Result<(), QueryFault> {
    let (Query::Select { pattern, .. }
    | Query::Construct { pattern, .. }
    | Query::Describe { pattern, .. }
    | Query::Ask { pattern, .. }) = query;
    let mut bounds = Bounds::default();
    let rows = bounds.rows(pattern);
    if bounds.has_service {
        return Err(QueryFault::Service);
    }
    if bounds.patterns > MAX_PATTERNS || bounds.expressions > MAX_EXPRESSIONS {
        return Err(QueryFault::TooComplex(format!(
            "it has more than {MAX_PATTERNS} patterns or {MAX_EXPRESSIONS} parts of expressions"
        )));
    }
    if rows > MAX_ROWS {
        return Err(QueryFault::TooComplex(format!(
            "its VALUES make more than {MAX_ROWS} rows with each other"
        )));
    }
    if bounds.growth > MAX_GROWTH {
        return Err(QueryFault::TooComplex("its CONCAT and REPLACE make texts out of each other that may grow without end; use fewer of them".to_owned()));
    }
    Ok(())
}

#[derive(Debug)]
struct Bounds {
    has_service: bool,
    patterns: usize,
    expressions: usize,
    /// Upper limit of the growth of texts.
    growth: f64,
}

impl Default for Bounds {
    fn default() -> Self {
        Self {
            has_service: false,
            patterns: 0,
            expressions: 0,
            growth: 1.0,
        }
    }
}

impl Bounds {
    /// Returns the maximum number of rows of the pattern for each row from statements.
    fn rows(&mut self, pattern: &GraphPattern) -> f64 {
        self.patterns += 1;
        match pattern {
            GraphPattern::Bgp { patterns } => {
                self.patterns += patterns.len();
                1.0
            }
            GraphPattern::Path { path, .. } => {
                self.path(path);
                1.0
            }
            GraphPattern::Values { bindings, .. } => count(bindings.len()),
            GraphPattern::Join { left, right } | GraphPattern::Lateral { left, right } => {
                self.rows(left) * self.rows(right)
            }
            GraphPattern::LeftJoin {
                left,
                right,
                expression,
            } => {
                let rows = self.rows(left) * self.rows(right).max(1.0);
                rows * expression
                    .as_ref()
                    .map_or(1.0, |expression| self.expression(expression))
            }
            GraphPattern::Minus { left, right } => self.rows(left) * self.rows(right).max(1.0),
            GraphPattern::Union { left, right } => self.rows(left) + self.rows(right),
            GraphPattern::Filter { expr, inner } => self.rows(inner) * self.expression(expr),
            GraphPattern::Extend {
                inner, expression, ..
            } => self.rows(inner) * self.expression(expression),
            GraphPattern::OrderBy { inner, expression } => {
                let mut rows = self.rows(inner);
                for OrderExpression::Asc(expression) | OrderExpression::Desc(expression) in
                    expression
                {
                    rows *= self.expression(expression);
                }
                rows
            }
            GraphPattern::Group {
                inner, aggregates, ..
            } => {
                let mut rows = self.rows(inner);
                for (_, aggregate) in aggregates {
                    if let AggregateExpression::FunctionCall { expr, .. } = aggregate {
                        rows *= self.expression(expr);
                    }
                }
                rows
            }
            GraphPattern::Graph { inner, .. }
            | GraphPattern::Project { inner, .. }
            | GraphPattern::Distinct { inner }
            | GraphPattern::Reduced { inner }
            | GraphPattern::Slice { inner, .. } => self.rows(inner),
            GraphPattern::Service { .. } => {
                self.has_service = true;
                1.0
            }
        }
    }

    fn path(&mut self, path: &PropertyPathExpression) {
        self.patterns += 1;
        match path {
            PropertyPathExpression::NamedNode(_) => {}
            PropertyPathExpression::NegatedPropertySet(all) => self.patterns += all.len(),
            PropertyPathExpression::Reverse(path)
            | PropertyPathExpression::ZeroOrMore(path)
            | PropertyPathExpression::OneOrMore(path)
            | PropertyPathExpression::ZeroOrOne(path) => self.path(path),
            PropertyPathExpression::Sequence(one, other)
            | PropertyPathExpression::Alternative(one, other) => {
                self.path(one);
                self.path(other);
            }
        }
    }

    /// Returns the maximum number of rows from the patterns inside an expression for one row.
    fn expression(&mut self, expression: &Expression) -> f64 {
        self.expressions += 1;
        match expression {
            Expression::NamedNode(_)
            | Expression::Literal(_)
            | Expression::Variable(_)
            | Expression::Bound(_) => 1.0,
            Expression::Exists(pattern) => self.rows(pattern).max(1.0),
            Expression::UnaryPlus(one) | Expression::UnaryMinus(one) | Expression::Not(one) => {
                self.expression(one)
            }
            Expression::Or(a, b)
            | Expression::And(a, b)
            | Expression::Equal(a, b)
            | Expression::SameTerm(a, b)
            | Expression::Greater(a, b)
            | Expression::GreaterOrEqual(a, b)
            | Expression::Less(a, b)
            | Expression::LessOrEqual(a, b)
            | Expression::Add(a, b)
            | Expression::Subtract(a, b)
            | Expression::Multiply(a, b)
            | Expression::Divide(a, b) => self.expression(a) * self.expression(b),
            Expression::If(a, b, c) => self.expression(a) * self.expression(b) * self.expression(c),
            Expression::In(one, all) => self.expression(one) * self.all(all),
            Expression::Coalesce(all) => self.all(all),
            Expression::FunctionCall(function, all) => {
                self.growth *= growth(function, all);
                self.all(all)
            }
        }
    }

    fn all(&mut self, all: &[Expression]) -> f64 {
        all.iter()
            .map(|expression| self.expression(expression))
            .product()
    }
}

/// Returns the maximum ratio of the length of a function's result to the length of its arguments.
fn growth(function: &Function, all: &[Expression]) -> f64 {
    if *function == Function::Concat {
        let parts = all
            .iter()
            .filter(|part| !matches!(part, Expression::Literal(_)));
        count(parts.count()).max(1.0)
    } else if *function == Function::Replace {
        match all.get(2) {
            Some(Expression::Literal(with)) => count(with.value().len()).max(1.0),
            _ => UNKNOWN_GROWTH,
        }
    } else if *function == Function::EncodeForUri {
        3.0
    } else {
        1.0
    }
}

/// Converts a number; the result is exact below 2^32, and larger numbers become the maximum, which
/// exceeds every limit.
fn count(number: usize) -> f64 {
    u32::try_from(number).map_or(f64::MAX, f64::from)
}

const MAX_DEPTH: usize = 200;
const MAX_PATTERNS: usize = 300;
const MAX_EXPRESSIONS: usize = 1000;
const MAX_ROWS: f64 = 100_000.0;
/// Allows up to 64 MB from a query of at most 16 kB.
const MAX_GROWTH: f64 = 4096.0;
const UNKNOWN_GROWTH: f64 = 256.0;
