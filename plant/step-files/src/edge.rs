//! Edges: the bounded curves between vertices, with bounds of their extents.

use std::f64::consts::TAU;

use crate::fault::ShapeFault;
use crate::spline::{BezierCurve, SplineCurve, cost_of, nearest_of};
use crate::vector::{Placement, Vector};
use crate::work::ReadingBudget;

/// Largest distance in millimetres at which points, curves and surfaces count as coincident.
pub(crate) const TOLERANCE: f64 = 0.01;
/// Largest distance in millimetres of a chord from its curve.
const CHORD: f64 = 0.004;
/// Width in millimetres at which the search for an extreme of a spline ends.
pub(crate) const NARROW: f64 = 0.001;
/// Maximum number of steps of the search for an extreme.
pub(crate) const MOST_STEPS: usize = 4000;
/// Maximum number of points of a polyline.
const MOST_POINTS: usize = 8192;

/// A curve without ends.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Curve {
    Line {
        point: Vector,
        direction: Vector,
    },
    /// A circle or an ellipse, with its radii along x and y.
    Ellipse {
        placement: Placement,
        x: f64,
        y: f64,
    },
    Spline(SplineCurve),
}

impl Curve {
    /// Returns about the number of steps that an edge on the curve needs.
    pub(crate) fn cost(&self) -> u64 {
        match self {
            Self::Line { .. } | Self::Ellipse { .. } => 16,
            Self::Spline(spline) => spline.cost(),
        }
    }
}

/// Bounds of the largest value of a linear function: the value is certainly reached, and certainly
/// not exceeded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Bounds {
    pub(crate) reached: f64,
    pub(crate) limit: f64,
}

impl Bounds {
    pub(crate) const NONE: Self = Self {
        reached: f64::NEG_INFINITY,
        limit: f64::NEG_INFINITY,
    };

    pub(crate) fn exact(value: f64) -> Self {
        Self {
            reached: value,
            limit: value,
        }
    }

    pub(crate) fn with(self, other: Self) -> Self {
        Self {
            reached: self.reached.max(other.reached),
            limit: self.limit.max(other.limit),
        }
    }
}

/// The part of a curve that an edge has.
#[derive(Debug, Clone, PartialEq)]
enum Span {
    Line,
    /// From an angle over a sweep, which is negative if the angle falls.
    Arc {
        placement: Placement,
        x: f64,
        y: f64,
        from: f64,
        sweep: f64,
    },
    Pieces(Vec<BezierCurve>),
}

/// An edge between two points.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct EdgeSpan {
    first: Vector,
    last: Vector,
    span: Span,
    /// Points from the start to the end, whose chords are close to the curve.
    pub(crate) points: Vec<Vector>,
}

impl EdgeSpan {
    /// Creates an edge between two points of a curve. The points are the same point for a closed
    /// edge. `along` says whether the edge runs in the direction of the curve.
    pub(crate) fn new(
        curve: &Curve,
        (first, last): (Vector, Vector),
        is_closed: bool,
        along: bool,
    ) -> Result<Self, ShapeFault> {
        let span = match curve {
            Curve::Line { point, direction } => {
                line((*point, *direction), (first, last), is_closed, along)?
            }
            Curve::Ellipse { placement, x, y } => {
                arc((placement, *x, *y), (first, last), is_closed, along)?
            }
            Curve::Spline(spline) => {
                let pieces = ordered_pieces(spline, (first, last), is_closed, along)?;
                Span::Pieces(pieces)
            }
        };
        let points = span.points((first, last))?;
        Ok(Self {
            first,
            last,
            span,
            points,
        })
    }

    /// Returns about the number of steps that made the points of the edge.
    pub(crate) fn cost(&self) -> u64 {
        let of_piece = match &self.span {
            Span::Pieces(pieces) => pieces.first().map_or(1, BezierCurve::cost),
            Span::Line | Span::Arc { .. } => 1,
        };
        cost_of(&[self.points.len(), of_piece])
    }

    /// Returns bounds of the largest value in a direction, and counts its work.
    pub(crate) fn bounds(&self, direction: Vector, work: &mut ReadingBudget<'_>) -> Bounds {
        let ends = self.first.dot(direction).max(self.last.dot(direction));
        let mut bounds = Bounds::exact(ends);
        match &self.span {
            Span::Line => {}
            Span::Arc {
                placement,
                x,
                y,
                from,
                sweep,
            } => {
                let (a, b) = (
                    placement.x.dot(direction) * x,
                    placement.y.dot(direction) * y,
                );
                let extreme = b.atan2(a);
                let (start, length) = if *sweep < 0.0 {
                    (from + sweep, -sweep)
                } else {
                    (*from, *sweep)
                };
                // Extremes within rounding of an end are as high as the end.
                if (extreme - start).rem_euclid(TAU) <= length {
                    let value = placement.origin.dot(direction) + a.hypot(b);
                    bounds = bounds.with(Bounds::exact(value));
                }
            }
            Span::Pieces(pieces) => bounds = bounds.with(extreme(pieces, direction, work)),
        }
        bounds
    }
}

/// Returns bounds of the largest value of Bezier pieces in a direction: pieces whose control points
/// are above the points of the curve are halved.
fn extreme(pieces: &[BezierCurve], direction: Vector, work: &mut ReadingBudget<'_>) -> Bounds {
    let value = |point: Vector| point.dot(direction);
    let ends = pieces
        .iter()
        .flat_map(|piece| [piece.first(), piece.last()]);
    let mut bounds = Bounds::NONE;
    bounds.reached = ends.map(value).fold(bounds.reached, f64::max);
    let mut open: Vec<BezierCurve> = pieces.to_vec();
    let mut steps = 0;
    while let Some(piece) = open.pop() {
        work.add(cost_of(&[piece.cost(), 2]));
        let most = piece.most(value);
        if most <= bounds.reached + NARROW || steps >= MOST_STEPS {
            bounds.limit = bounds.limit.max(most);
            continue;
        }
        steps += 1;
        let (low, high) = piece.split(0.5);
        bounds.reached = bounds.reached.max(value(low.last()));
        open.extend([low, high]);
    }
    bounds.limit = bounds.limit.max(bounds.reached);
    bounds
}

fn line(
    (point, direction): (Vector, Vector),
    (first, last): (Vector, Vector),
    is_closed: bool,
    along: bool,
) -> Result<Span, ShapeFault> {
    let direction = direction.unit().ok_or(ShapeFault::NoDirection)?;
    for vertex in [first, last] {
        let distance = (vertex - point).cross(direction).length();
        if distance > TOLERANCE {
            return Err(ShapeFault::VertexOffCurve { distance });
        }
    }
    let way = (last - first).dot(direction);
    if is_closed || way == 0.0 {
        return Err(ShapeFault::ClosedLine);
    }
    if (way > 0.0) == along {
        Ok(Span::Line)
    } else {
        Err(ShapeFault::SenseOfEdge)
    }
}

fn arc(
    (placement, x, y): (&Placement, f64, f64),
    (first, last): (Vector, Vector),
    is_closed: bool,
    along: bool,
) -> Result<Span, ShapeFault> {
    if !(x > TOLERANCE && y > TOLERANCE) {
        return Err(ShapeFault::Radius { radius: x.min(y) });
    }
    let mut angles = [0.0; 2];
    for (vertex, angle) in [first, last].into_iter().zip(&mut angles) {
        let local = placement.local(vertex);
        let found = (local.y / y).atan2(local.x / x);
        let on = placement.point(Vector::new(found.cos() * x, found.sin() * y, 0.0));
        let distance = (on - vertex).length();
        if distance > TOLERANCE {
            return Err(ShapeFault::VertexOffCurve { distance });
        }
        *angle = found;
    }
    let [from, to] = angles;
    let sweep = match (is_closed, along) {
        (true, true) => TAU,
        (true, false) => -TAU,
        (false, true) => (to - from).rem_euclid(TAU),
        (false, false) => -(from - to).rem_euclid(TAU),
    };
    // An arc that is shorter than the tolerance may as well be the rest of the circle.
    let chord = (first - last).length();
    if !is_closed && chord <= 2.0 * TOLERANCE {
        return Err(ShapeFault::ShortArc { length: chord });
    }
    Ok(Span::Arc {
        placement: *placement,
        x,
        y,
        from,
        sweep,
    })
}

/// Returns the pieces of a spline between two of its points, in the direction of the edge.
fn ordered_pieces(
    spline: &SplineCurve,
    (first, last): (Vector, Vector),
    is_closed: bool,
    along: bool,
) -> Result<Vec<BezierCurve>, ShapeFault> {
    let (start, end) = spline.domain();
    let whole = spline.pieces((start, end));
    let (Some(head), Some(tail)) = (whole.first(), whole.last()) else {
        return Err(ShapeFault::ShortArc { length: 0.0 });
    };
    let (head, tail) = (head.first(), tail.last());
    let is_ring = (head - tail).length() <= TOLERANCE;
    // The edge in the direction of the curve.
    let (from, to) = if along { (first, last) } else { (last, first) };
    let at_end = |point: Vector, end: Vector| (point - end).length() <= TOLERANCE;
    let find = |point: Vector| {
        let (at, distance) = nearest_of(&whole, &|at: Vector| (at - point).length());
        if distance <= TOLERANCE {
            Ok(at)
        } else {
            Err(ShapeFault::VertexOffCurve { distance })
        }
    };
    let from = if at_end(from, head) {
        start
    } else {
        find(from)?
    };
    let to = if at_end(to, tail) { end } else { find(to)? };
    let mut pieces = if from < to {
        if is_closed && !is_ring {
            return Err(ShapeFault::ClosedLine);
        }
        spline.pieces((from, to))
    } else if is_ring && (is_closed || from > to) {
        let mut pieces = spline.pieces((from, end));
        pieces.extend(spline.pieces((start, to)));
        pieces
    } else {
        return Err(ShapeFault::SenseOfEdge);
    };
    if !along {
        pieces = pieces.iter().rev().map(BezierCurve::reversed).collect();
    }
    if pieces.is_empty() {
        return Err(ShapeFault::ShortArc { length: 0.0 });
    }
    Ok(pieces)
}

impl Span {
    fn points(&self, (first, last): (Vector, Vector)) -> Result<Vec<Vector>, ShapeFault> {
        match self {
            Self::Line => {
                let shares = (0..=8).map(|at| f64::from(at) / 8.0);
                Ok(shares.map(|at| first + (last - first) * at).collect())
            }
            Self::Arc {
                placement,
                x,
                y,
                from,
                sweep,
            } => {
                let mut count = 8_u32;
                while x.max(*y) * (1.0 - (sweep / f64::from(count) / 2.0).cos()) > CHORD
                    || sweep.abs() / f64::from(count) > 0.4
                {
                    count *= 2;
                    if count >= 8192 {
                        return Err(ShapeFault::TooLarge);
                    }
                }
                let point = |at: u32| {
                    let angle = from + sweep * f64::from(at) / f64::from(count);
                    placement.point(Vector::new(x * angle.cos(), y * angle.sin(), 0.0))
                };
                Ok((0..=count).map(point).collect())
            }
            Self::Pieces(pieces) => {
                let mut points: Vec<Vector> =
                    pieces.iter().take(1).map(BezierCurve::first).collect();
                for piece in pieces {
                    flatten(piece, &mut points, 0)?;
                }
                Ok(points)
            }
        }
    }
}

/// Appends points of a curve, at least four, behind its first point.
fn flatten(piece: &BezierCurve, points: &mut Vec<Vector>, depth: u32) -> Result<(), ShapeFault> {
    if points.len() >= MOST_POINTS || depth > 30 {
        return Err(ShapeFault::TooLarge);
    }
    if depth >= 2 && piece.bulge() <= CHORD {
        points.push(piece.last());
        return Ok(());
    }
    let (low, high) = piece.split(0.5);
    flatten(&low, points, depth + 1)?;
    flatten(&high, points, depth + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn circle() -> Curve {
        Curve::Ellipse {
            placement: Placement::IDENTITY,
            x: 5.0,
            y: 5.0,
        }
    }

    #[test]
    fn the_direction_of_an_arc_decides_its_extent() {
        let (right, up) = (Vector::new(5.0, 0.0, 0.0), Vector::new(0.0, 5.0, 0.0));
        let quarter = EdgeSpan::new(&circle(), (right, up), false, true).unwrap();
        assert!(
            (quarter
                .bounds(-Vector::X, &mut ReadingBudget::new(&|| false))
                .limit
                - 0.0)
                .abs()
                < 1e-9
        );
        let rest = EdgeSpan::new(&circle(), (right, up), false, false).unwrap();
        assert!(
            (rest
                .bounds(-Vector::X, &mut ReadingBudget::new(&|| false))
                .reached
                - 5.0)
                .abs()
                < 1e-9
        );
        let whole = EdgeSpan::new(&circle(), (right, right), true, true).unwrap();
        assert!(
            (whole
                .bounds(-Vector::Y, &mut ReadingBudget::new(&|| false))
                .reached
                - 5.0)
                .abs()
                < 1e-9
        );
    }

    #[test]
    fn vertices_off_the_curve_and_wrong_senses_are_refused() {
        let off = Vector::new(5.02, 0.0, 0.0);
        let up = Vector::new(0.0, 5.0, 0.0);
        let edge = EdgeSpan::new(&circle(), (off, up), false, true);
        assert!(
            matches!(edge, Err(ShapeFault::VertexOffCurve { .. })),
            "{edge:?}"
        );
        let line = Curve::Line {
            point: Vector::default(),
            direction: Vector::X,
        };
        let ends = (Vector::default(), Vector::X);
        assert!(EdgeSpan::new(&line, ends, false, true).is_ok());
        let edge = EdgeSpan::new(&line, ends, false, false);
        assert_eq!(edge, Err(ShapeFault::SenseOfEdge));
    }
}
