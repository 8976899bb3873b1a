//! B-spline curves and surfaces as Bezier pieces, whose control points bound them.

use crate::vector::Vector;

/// A control point in homogeneous coordinates: the point times its weight, and the weight.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct ControlPoint {
    point: Vector,
    weight: f64,
}

impl ControlPoint {
    fn new(point: Vector, weight: f64) -> Self {
        let point = point * weight;
        Self { point, weight }
    }

    pub(crate) fn position(self) -> Vector {
        self.point * (1.0 / self.weight)
    }

    /// Returns the point between two, at 0 this one and at 1 the other.
    fn between(self, other: Self, at: f64) -> Self {
        Self {
            point: self.point * (1.0 - at) + other.point * at,
            weight: self.weight * (1.0 - at) + other.weight * at,
        }
    }
}

/// A fault of a B-spline.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SplineFault {
    /// The degree is not supported.
    #[error("its degree is not from 1 to {MOST_DEGREE}")]
    Degree,
    /// The numbers of knots, multiplicities and control points do not fit.
    #[error("its knots, multiplicities and control points do not fit together")]
    Count,
    /// The knots do not rise.
    #[error("its knots do not rise, or an inner knot interrupts it")]
    Knots,
    /// A weight is not positive, or weights differ by more than a factor of a million.
    #[error("its weights are not positive numbers of similar size")]
    Weights,
}

/// The knots of one direction.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Knots {
    degree: usize,
    all: Vec<f64>,
}

impl Knots {
    /// Creates knots with multiplicities for a number of control points.
    pub(crate) fn new(
        degree: i64,
        (multiplicities, values): (&[i64], &[f64]),
        count: usize,
    ) -> Result<Self, SplineFault> {
        let degree = usize::try_from(degree).map_err(|_| SplineFault::Degree)?;
        if !(1..=MOST_DEGREE).contains(&degree) {
            return Err(SplineFault::Degree);
        }
        if multiplicities.len() != values.len() || values.len() < 2 || count <= degree {
            return Err(SplineFault::Count);
        }
        let mut all = Vec::new();
        for (at, (times, value)) in multiplicities.iter().zip(values).enumerate() {
            let most = if at == 0 || at + 1 == values.len() {
                degree + 1
            } else {
                degree
            };
            let times = usize::try_from(*times).map_err(|_| SplineFault::Knots)?;
            let rises = all.last().is_none_or(|last: &f64| value > last) && value.is_finite();
            if !(1..=most).contains(&times) || !rises {
                return Err(SplineFault::Knots);
            }
            all.extend(std::iter::repeat_n(*value, times));
            if all.len() > count + degree + 1 {
                return Err(SplineFault::Count);
            }
        }
        if all.len() != count + degree + 1 {
            return Err(SplineFault::Count);
        }
        let knots = Self { degree, all };
        let (from, to) = knots.domain();
        if from < to {
            Ok(knots)
        } else {
            Err(SplineFault::Knots)
        }
    }

    fn knot(&self, at: usize) -> f64 {
        self.all.get(at).copied().unwrap_or_default()
    }

    /// Returns the first and the last parameter.
    pub(crate) fn domain(&self) -> (f64, f64) {
        let last = self.all.len().saturating_sub(self.degree + 1);
        (self.knot(self.degree), self.knot(last))
    }

    /// Returns the spans between knots that are in a range: the index of the knot, the first and
    /// the last parameter.
    fn spans(&self, (from, to): (f64, f64)) -> Vec<(usize, f64, f64)> {
        let last = self.all.len().saturating_sub(self.degree + 1);
        let inner = self.degree..last;
        let spans = inner.filter_map(|at| {
            let from = self.knot(at).max(from);
            let to = self.knot(at + 1).min(to);
            (self.knot(at) < self.knot(at + 1) && from < to).then_some((at, from, to))
        });
        spans.collect()
    }

    /// Returns the number of spans, and the square of the number of control points of each.
    fn size(&self) -> (usize, usize) {
        let order = self.degree + 1;
        (self.spans(self.domain()).len(), order * order)
    }

    /// Evaluates the polar form of the piece of a span at `degree` arguments: the first `firsts`
    /// are `to`, all others are `from`.
    fn polar(
        &self,
        controls: &[ControlPoint],
        (span, from, to): (usize, f64, f64),
        firsts: usize,
    ) -> ControlPoint {
        let degree = self.degree;
        let start = span.saturating_sub(degree);
        let mut row: Vec<ControlPoint> = (start..=span)
            .map(|at| controls.get(at).copied().unwrap_or_default())
            .collect();
        for round in 1..=degree {
            let argument = if round <= firsts { to } else { from };
            let next = (round..=degree).map(|at| {
                let low = self.knot(at + span - degree);
                let high = self.knot(at + 1 + span - round);
                let share = (argument - low) / (high - low);
                let offset = at - round;
                let of = |at: usize| row.get(at).copied().unwrap_or_default();
                of(offset).between(of(offset + 1), share)
            });
            row = next.collect();
        }
        row.first().copied().unwrap_or_default()
    }

    fn bezier(&self, controls: &[ControlPoint], span: (usize, f64, f64)) -> Vec<ControlPoint> {
        (0..=self.degree)
            .map(|firsts| self.polar(controls, span, firsts))
            .collect()
    }
}

/// Creates control points; without weights, all weights are 1.
fn controls(points: &[Vector], weights: Option<&[f64]>) -> Result<Vec<ControlPoint>, SplineFault> {
    let Some(weights) = weights else {
        return Ok(points
            .iter()
            .map(|point| ControlPoint::new(*point, 1.0))
            .collect());
    };
    if weights.len() != points.len() {
        return Err(SplineFault::Count);
    }
    let smallest = weights.iter().copied().fold(f64::INFINITY, f64::min);
    let largest = weights.iter().copied().fold(0.0, f64::max);
    let are_fit = weights
        .iter()
        .all(|weight| weight.is_finite() && *weight > 0.0);
    if !are_fit || largest > smallest * 1e6 {
        return Err(SplineFault::Weights);
    }
    // The scale of the weights has no effect.
    let all = points.iter().zip(weights);
    Ok(all
        .map(|(point, weight)| ControlPoint::new(*point, weight / largest))
        .collect())
}

/// A B-spline curve.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SplineCurve {
    knots: Knots,
    controls: Vec<ControlPoint>,
}

impl SplineCurve {
    pub(crate) fn new(
        knots: Knots,
        points: &[Vector],
        weights: Option<&[f64]>,
    ) -> Result<Self, SplineFault> {
        let controls = controls(points, weights)?;
        Ok(Self { knots, controls })
    }

    pub(crate) fn domain(&self) -> (f64, f64) {
        self.knots.domain()
    }

    /// Returns about the number of steps that a search on the curve needs.
    pub(crate) fn cost(&self) -> u64 {
        let (spans, square) = self.knots.size();
        cost_of(&[spans, square, OF_SEARCH])
    }

    /// Returns the Bezier pieces in a range of parameters.
    pub(crate) fn pieces(&self, range: (f64, f64)) -> Vec<BezierCurve> {
        let spans = self.knots.spans(range).into_iter();
        spans
            .map(|span| BezierCurve {
                controls: self.knots.bezier(&self.controls, span),
                from: span.1,
                to: span.2,
            })
            .collect()
    }
}

/// A Bezier curve with its range of parameters.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct BezierCurve {
    pub(crate) controls: Vec<ControlPoint>,
    pub(crate) from: f64,
    pub(crate) to: f64,
}

impl BezierCurve {
    /// Returns about the number of steps that splitting needs.
    pub(crate) fn cost(&self) -> usize {
        self.controls.len() * self.controls.len()
    }

    pub(crate) fn first(&self) -> Vector {
        self.controls
            .first()
            .map_or_else(Vector::default, |all| all.position())
    }

    pub(crate) fn last(&self) -> Vector {
        self.controls
            .last()
            .map_or_else(Vector::default, |all| all.position())
    }

    pub(crate) fn reversed(&self) -> Self {
        Self {
            controls: self.controls.iter().rev().copied().collect(),
            from: self.to,
            to: self.from,
        }
    }

    /// Returns both halves of the curve, split at a share of its parameters.
    pub(crate) fn split(&self, at: f64) -> (Self, Self) {
        let (low, high) = split(&self.controls, at);
        let middle = self.from + (self.to - self.from) * at;
        let low = Self {
            controls: low,
            from: self.from,
            to: middle,
        };
        let high = Self {
            controls: high,
            from: middle,
            to: self.to,
        };
        (low, high)
    }

    /// Returns the point at a share of the parameters, from 0 to 1.
    pub(crate) fn at(&self, share: f64) -> Vector {
        self.split(share).0.last()
    }

    /// Returns an upper bound of a function that is convex in space.
    pub(crate) fn most(&self, of: impl Fn(Vector) -> f64) -> f64 {
        let values = self.controls.iter().map(|control| of(control.position()));
        values.fold(f64::NEG_INFINITY, f64::max)
    }

    /// Returns an upper bound of the distance of the curve from its chord.
    pub(crate) fn bulge(&self) -> f64 {
        let (first, last) = (self.first(), self.last());
        self.most(|point| off_segment(point, first, last))
    }

    /// Returns the share of several that is nearest to a point, and its distance.
    fn about_nearest(&self, distance: &impl Fn(Vector) -> f64) -> (f64, f64) {
        let tries = (0..=TRIES).map(|at| f64::from(at) / f64::from(TRIES));
        let tries = tries.map(|share| (share, distance(self.at(share))));
        let best = tries.min_by(|a, b| a.1.total_cmp(&b.1));
        best.unwrap_or((0.0, f64::INFINITY))
    }

    /// Returns the parameter of the nearest point, and its distance.
    fn nearest(&self, best: (f64, f64), distance: &impl Fn(Vector) -> f64) -> (f64, f64) {
        // The golden section: the interval shrinks below 1e-9 of the piece.
        const GOLDEN: f64 = 0.618_033_988_749_894_9;
        let step = 1.0 / f64::from(TRIES);
        let (mut low, mut high) = ((best.0 - step).max(0.0), (best.0 + step).min(1.0));
        for _ in 0..40 {
            let (a, b) = (high - (high - low) * GOLDEN, low + (high - low) * GOLDEN);
            if distance(self.at(a)) <= distance(self.at(b)) {
                high = b;
            } else {
                low = a;
            }
        }
        let ends = [low, high, f64::midpoint(low, high), best.0];
        let ends = ends.map(|share| (share, distance(self.at(share))));
        let best = ends
            .into_iter()
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .unwrap_or(best);
        (self.from + (self.to - self.from) * best.0, best.1)
    }
}

/// Returns the parameter of the nearest point of several pieces, and its distance.
pub(crate) fn nearest_of(pieces: &[BezierCurve], distance: &impl Fn(Vector) -> f64) -> (f64, f64) {
    let about = pieces
        .iter()
        .map(|piece| (piece, piece.about_nearest(distance)));
    let mut about: Vec<_> = about.collect();
    about.sort_by(|a, b| a.1.1.total_cmp(&b.1.1));
    let near = about.into_iter().take(REFINED);
    let near = near.map(|(piece, best)| piece.nearest(best, distance));
    let best = near.min_by(|a, b| a.1.total_cmp(&b.1));
    best.unwrap_or((0.0, f64::INFINITY))
}

/// Returns the product of some counts.
pub(crate) fn cost_of(counts: &[usize]) -> u64 {
    let product = counts
        .iter()
        .fold(1, |all: usize, count| all.saturating_mul(*count));
    u64::try_from(product).unwrap_or(u64::MAX)
}

/// Returns the distance of a point from a segment.
pub(crate) fn off_segment(point: Vector, first: Vector, last: Vector) -> f64 {
    let chord = last - first;
    let square = chord.dot(chord);
    let at = if square > 0.0 {
        ((point - first).dot(chord) / square).clamp(0.0, 1.0)
    } else {
        0.0
    };
    (point - (first + chord * at)).length()
}

fn split(controls: &[ControlPoint], at: f64) -> (Vec<ControlPoint>, Vec<ControlPoint>) {
    let mut row = controls.to_vec();
    let (mut low, mut high) = (Vec::new(), Vec::new());
    while let (Some(first), Some(last)) = (row.first().copied(), row.last().copied()) {
        low.push(first);
        high.push(last);
        let pairs = row.iter().zip(row.iter().skip(1));
        row = pairs.map(|(a, b)| a.between(*b, at)).collect();
    }
    high.reverse();
    (low, high)
}

/// A B-spline surface. Its control points are rows along v, one row for each control point of u.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SplineSurface {
    u: Knots,
    v: Knots,
    rows: Vec<Vec<ControlPoint>>,
}

impl SplineSurface {
    pub(crate) fn new(
        u: Knots,
        v: Knots,
        points: &[Vec<Vector>],
        weights: Option<&[Vec<f64>]>,
    ) -> Result<Self, SplineFault> {
        let width = points.first().map_or(0, Vec::len);
        let is_grid = points.iter().all(|row| row.len() == width) && width > 0;
        let is_same = weights.is_none_or(|weights| {
            weights.len() == points.len() && weights.iter().all(|row| row.len() == width)
        });
        if !is_grid || !is_same {
            return Err(SplineFault::Count);
        }
        // All weights have one scale.
        let flat: Option<Vec<f64>> = weights.map(|weights| weights.concat());
        let flat = controls(&points.concat(), flat.as_deref())?;
        let rows = flat.chunks(width).map(<[ControlPoint]>::to_vec).collect();
        Ok(Self { u, v, rows })
    }

    /// Returns the number of patches, and about the number of steps that making them needs.
    pub(crate) fn size(&self) -> (usize, u64) {
        let ((of_u, u), (of_v, v)) = (self.u.size(), self.v.size());
        let count = of_u.saturating_mul(of_v);
        let width = self.rows.first().map_or(0, Vec::len);
        let of_columns = cost_of(&[of_u, width, u, self.u.degree + 1]);
        // Each patch has more points at which searches begin than control points.
        let of_patches = cost_of(&[count, u, v, 8]);
        (count, of_columns.saturating_add(of_patches))
    }

    /// Returns the Bezier patches of the whole surface.
    pub(crate) fn patches(&self) -> Vec<BezierPatch> {
        let mut all = Vec::new();
        for span in self.u.spans(self.u.domain()) {
            let width = self.rows.first().map_or(0, Vec::len);
            // The control points of this span along u, for each column.
            let columns: Vec<Vec<ControlPoint>> = (0..width)
                .map(|at| {
                    let column: Vec<ControlPoint> = self
                        .rows
                        .iter()
                        .map(|row| row.get(at).copied().unwrap_or_default())
                        .collect();
                    self.u.bezier(&column, span)
                })
                .collect();
            for across in self.v.spans(self.v.domain()) {
                let rows = transposed(&columns);
                let rows = rows.iter().map(|row| self.v.bezier(row, across)).collect();
                all.push(BezierPatch {
                    rows,
                    u: (span.1, span.2),
                    v: (across.1, across.2),
                });
            }
        }
        all
    }

    pub(crate) fn domain(&self) -> ((f64, f64), (f64, f64)) {
        (self.u.domain(), self.v.domain())
    }
}

/// A Bezier patch with its ranges of parameters.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct BezierPatch {
    /// Rows along v, one for each control point of u.
    rows: Vec<Vec<ControlPoint>>,
    pub(crate) u: (f64, f64),
    pub(crate) v: (f64, f64),
}

impl BezierPatch {
    /// Returns about the number of steps that a point of the patch needs.
    pub(crate) fn cost(&self) -> usize {
        let width = self.rows.first().map_or(0, Vec::len);
        self.rows.len().saturating_mul(width)
    }

    pub(crate) fn most(&self, of: impl Fn(Vector) -> f64) -> f64 {
        let values = self.rows.iter().flatten();
        let values = values.map(|control| of(control.position()));
        values.fold(f64::NEG_INFINITY, f64::max)
    }

    /// Returns the degrees along u and v.
    pub(crate) fn degrees(&self) -> (usize, usize) {
        let of_v = self.rows.first().map_or(0, Vec::len);
        (self.rows.len().saturating_sub(1), of_v.saturating_sub(1))
    }

    /// Returns both halves, along the longer side of the patch.
    pub(crate) fn halves(&self) -> (Self, Self) {
        let corner = |row: Option<&Vec<ControlPoint>>, is_last: bool| {
            let row = row.map(Vec::as_slice).unwrap_or_default();
            let control = if is_last { row.last() } else { row.first() };
            control.map_or_else(Vector::default, |control| control.position())
        };
        let (first, last) = (self.rows.first(), self.rows.last());
        let along_u = (corner(first, false) - corner(last, false)).length()
            + (corner(first, true) - corner(last, true)).length();
        let along_v = (corner(first, false) - corner(first, true)).length()
            + (corner(last, false) - corner(last, true)).length();
        let (du, dv) = (self.u.1 - self.u.0, self.v.1 - self.v.0);
        // Closed patches have corners that meet; the parameters decide then.
        let is_u = if (along_u - along_v).abs() > 1e-6 * (along_u + along_v) {
            along_u > along_v
        } else {
            du > dv
        };
        if is_u {
            self.split_u(0.5)
        } else {
            self.split_v(0.5)
        }
    }

    pub(crate) fn split_u(&self, at: f64) -> (Self, Self) {
        let columns = transposed(&self.rows);
        let pairs: Vec<_> = columns.iter().map(|column| split(column, at)).collect();
        let (low, high): (Vec<_>, Vec<_>) = pairs.into_iter().unzip();
        let middle = self.u.0 + (self.u.1 - self.u.0) * at;
        let patch = |columns: &[Vec<ControlPoint>], u| Self {
            rows: transposed(columns),
            u,
            v: self.v,
        };
        (
            patch(&low, (self.u.0, middle)),
            patch(&high, (middle, self.u.1)),
        )
    }

    pub(crate) fn split_v(&self, at: f64) -> (Self, Self) {
        let pairs: Vec<_> = self.rows.iter().map(|row| split(row, at)).collect();
        let (low, high): (Vec<_>, Vec<_>) = pairs.into_iter().unzip();
        let middle = self.v.0 + (self.v.1 - self.v.0) * at;
        let patch = |rows, v| Self { rows, u: self.u, v };
        (
            patch(low, (self.v.0, middle)),
            patch(high, (middle, self.v.1)),
        )
    }

    /// Returns the point at shares of the parameters, with both derivatives by the shares.
    pub(crate) fn at(&self, u: f64, v: f64) -> (Vector, Vector, Vector) {
        let ends: Vec<Vec<ControlPoint>> = self.rows.iter().map(|row| near(row, v)).collect();
        let columns = transposed(&ends);
        let along: Vec<Vec<ControlPoint>> = columns.iter().map(|column| near(column, u)).collect();
        let of = |column: usize, row: usize| {
            let column = along.get(column).map(Vec::as_slice).unwrap_or_default();
            column.get(row).copied().unwrap_or_default()
        };
        // The last two points of de Casteljau in both directions give the point and tangents.
        let (a, b, c, d) = (of(0, 0), of(0, 1), of(1, 0), of(1, 1));
        let low = a.between(b, u);
        let high = c.between(d, u);
        let point = low.between(high, v).position();
        let left = a.between(c, v);
        let right = b.between(d, v);
        let of_u = f64_of(self.rows.len().saturating_sub(1));
        let of_v = f64_of(self.rows.first().map_or(0, Vec::len).saturating_sub(1));
        let middle = low.between(high, v).weight;
        let slope = |from: ControlPoint, to: ControlPoint, degree: f64| {
            let change = to.point - from.point - point * (to.weight - from.weight);
            change * (degree / middle)
        };
        (point, slope(left, right, of_u), slope(low, high, of_v))
    }
}

/// Returns the last two points of de Casteljau at a share.
fn near(controls: &[ControlPoint], at: f64) -> Vec<ControlPoint> {
    let mut row = controls.to_vec();
    while row.len() > 2 {
        let pairs = row.iter().zip(row.iter().skip(1));
        row = pairs.map(|(a, b)| a.between(*b, at)).collect();
    }
    row
}

fn transposed(rows: &[Vec<ControlPoint>]) -> Vec<Vec<ControlPoint>> {
    let width = rows.first().map_or(0, Vec::len);
    let column = |at: usize| {
        let column = rows
            .iter()
            .map(|row| row.get(at).copied().unwrap_or_default());
        column.collect()
    };
    (0..width).map(column).collect()
}

/// Converts a small count.
pub(crate) fn f64_of(count: usize) -> f64 {
    u32::try_from(count).map_or(f64::INFINITY, f64::from)
}

/// Number of parts of a piece that are compared in the search for the nearest point.
const TRIES: u32 = 24;
/// Number of pieces in which the nearest point is searched closely.
const REFINED: usize = 3;
/// Maximum degree, that of ISO 10303-42 implementations.
pub(crate) const MOST_DEGREE: usize = 15;
/// Number of points of a piece that a search tries.
pub(crate) const OF_SEARCH: usize = 56;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rational_arc_has_constant_radius_in_each_piece() {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let points = [
            Vector::new(5.0, 0.0, 0.0),
            Vector::new(5.0, 5.0, 0.0),
            Vector::new(0.0, 5.0, 0.0),
            Vector::new(-5.0, 5.0, 0.0),
            Vector::new(-5.0, 0.0, 0.0),
        ];
        let knots = Knots::new(2, (&[3, 2, 3], &[0.0, 1.0, 4.0]), 5).unwrap();
        let curve = SplineCurve::new(knots, &points, Some(&[1.0, half, 1.0, half, 1.0])).unwrap();
        let pieces = curve.pieces((0.5, 3.0));
        assert_eq!(pieces.len(), 2);
        for piece in &pieces {
            for at in 0..=10 {
                let radius = piece.at(f64::from(at) / 10.0).length();
                assert!((radius - 5.0).abs() < 1e-12, "{radius}");
            }
        }
    }

    #[test]
    fn unclamped_knots_are_evaluated_in_their_domain() {
        // A uniform cubic through points on a line is this line.
        let points: Vec<Vector> = (0..6)
            .map(|x| Vector::new(f64::from(x), 0.0, 0.0))
            .collect();
        let values: Vec<f64> = (0..10).map(f64::from).collect();
        let knots = Knots::new(3, (&[1; 10], &values), 6).unwrap();
        let curve = SplineCurve::new(knots, &points, None).unwrap();
        assert_eq!(curve.domain(), (3.0, 6.0));
        let pieces = curve.pieces((3.5, 6.0));
        assert_eq!(pieces.len(), 3);
        assert!((pieces[0].first().x - 1.5).abs() < 1e-12);
        assert!((pieces[2].last().x - 4.0).abs() < 1e-12);
    }

    #[test]
    fn the_derivatives_of_a_patch_are_its_slopes() {
        let row = |x: f64, z: f64| {
            vec![
                Vector::new(x, 0.0, z),
                Vector::new(x, 2.0, z + 3.0),
                Vector::new(x, 5.0, z),
            ]
        };
        let points = [row(0.0, 0.0), row(4.0, 1.0)];
        let u = Knots::new(1, (&[2, 2], &[0.0, 1.0]), 2).unwrap();
        let v = Knots::new(2, (&[3, 3], &[0.0, 1.0]), 3).unwrap();
        let weights = [vec![1.0, 0.5, 1.0], vec![1.0, 2.0, 1.0]];
        let surface = SplineSurface::new(u, v, &points, Some(&weights)).unwrap();
        let patches = surface.patches();
        let (point, du, dv) = patches[0].at(0.3, 0.6);
        let step = 1e-6;
        let by_u = (patches[0].at(0.3 + step, 0.6).0 - point) * (1.0 / step);
        let by_v = (patches[0].at(0.3, 0.6 + step).0 - point) * (1.0 / step);
        assert!((by_u - du).length() < 1e-3, "{by_u:?} {du:?}");
        assert!((by_v - dv).length() < 1e-3, "{by_v:?} {dv:?}");
    }

    #[test]
    fn absurd_knots_are_refused() {
        for (degree, multiplicities, values, count, fault) in [
            (0, vec![1, 1], vec![0.0, 1.0], 2, SplineFault::Degree),
            (i64::MAX, vec![1, 1], vec![0.0, 1.0], 2, SplineFault::Degree),
            (2, vec![3, 3], vec![1.0, 0.0], 3, SplineFault::Knots),
            (2, vec![3, i64::MAX], vec![0.0, 1.0], 3, SplineFault::Knots),
            (2, vec![3, 3, 3], vec![0.0, 1.0, 2.0], 6, SplineFault::Knots),
            (2, vec![3, 3], vec![0.0, f64::NAN], 3, SplineFault::Knots),
            (2, vec![3, 3], vec![0.0, 1.0], 4, SplineFault::Count),
        ] {
            let read = Knots::new(degree, (&multiplicities, &values), count);
            assert_eq!(read, Err(fault), "{degree} {multiplicities:?} {values:?}");
        }
        let knots = Knots::new(1, (&[2, 2], &[0.0, 1.0]), 2).unwrap();
        let points = [Vector::X, Vector::Y];
        for weights in [[1.0, 0.0], [1.0, -1.0], [1.0, 1e9], [1.0, f64::NAN]] {
            let read = SplineCurve::new(knots.clone(), &points, Some(&weights));
            assert_eq!(read, Err(SplineFault::Weights), "{weights:?}");
        }
    }
}
