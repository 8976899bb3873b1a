//! The edges of a face in the coordinates of its surface, and which places they enclose.

use std::cmp::Ordering;

use crate::edge::{EdgeSpan, TOLERANCE};
use crate::fault::ShapeFault;
use crate::spline::off_segment;
use crate::surface::{ChartForm, Surface};
use crate::vector::Vector;

/// An edge of a face with its direction in the loop.
#[derive(Debug, Clone)]
pub(crate) struct FaceEdge<'e> {
    pub(crate) id: u64,
    pub(crate) span: &'e EdgeSpan,
    /// Whether the loop runs from the start to the end of the edge.
    pub(crate) along: bool,
    /// Whether the face uses the edge in both directions.
    pub(crate) is_seam: bool,
}

/// The place of the points around a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum FacePlace {
    Inside,
    Outside,
    /// The edges of the face are at this distance from the point.
    Near(f64),
}

/// The edges of a face in the coordinates of its surface.
#[derive(Debug)]
pub(crate) struct FaceChart {
    form: ChartForm,
    pub(crate) segments: Vec<ChartSegment>,
    /// The shear of s along t, by which straight lines of surfaces are not vertical.
    shear: f64,
    /// The number of the place that all others are counted from.
    base: i64,
    /// The number of the place where t is least, if it is certain.
    pub(crate) bottom: Option<i64>,
    /// Whether the face is the whole surface.
    pub(crate) is_whole: bool,
}

/// A short piece of an edge.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ChartSegment {
    /// The number of its edge in the face.
    edge: usize,
    s: f64,
    t: f64,
    ds: f64,
    dt: f64,
    first: Vector,
    last: Vector,
    pub(crate) is_seam: bool,
}

impl FaceChart {
    pub(crate) fn new(
        surface: &Surface,
        is_outward: bool,
        edges: &[FaceEdge<'_>],
    ) -> Result<Self, ShapeFault> {
        let form = surface.form();
        let mut courses: Vec<Vec<(Vector, f64, f64)>> = Vec::new();
        let mut has_pole = false;
        for edge in edges {
            let course = course(surface, edge)?;
            has_pole |= course.has_pole && !edge.is_seam;
            let mut points = course.points;
            // The face is left of its edges if its normal is that of s and t.
            if edge.along == (is_outward == surface.is_mirrored()) {
                points.reverse();
            }
            courses.push(points);
        }
        let range = |of: fn(&(Vector, f64, f64)) -> f64| {
            let values = courses.iter().flatten().map(of);
            let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |range, value| {
                (range.0.min(value), range.1.max(value))
            });
            (high - low).max(f64::MIN_POSITIVE)
        };
        let width = form.s.unwrap_or_else(|| range(|point| point.1));
        let shear = match form.t {
            Some(period) => width / period,
            None => 0.317_3 * width / range(|point| point.2),
        };
        if let Some(edge) = edges.first()
            && !(width.is_finite() && shear.is_finite())
        {
            return Err(ShapeFault::Orientation { edge: edge.id });
        }
        let mut chart = Self {
            form,
            segments: Vec::new(),
            shear,
            base: 0,
            bottom: None,
            is_whole: false,
        };
        let offset = chart.offset();
        for (number, (course, edge)) in courses.iter().zip(edges).enumerate() {
            for (from, to) in course.iter().zip(course.iter().skip(1)) {
                let dt = reduced(to.2 - from.2, form.t);
                let ds = reduced(to.1 - from.1, form.s) + shear * dt;
                chart.segments.push(ChartSegment {
                    edge: number,
                    s: from.1 + shear * from.2,
                    t: within(from.2 + offset, form.t),
                    ds,
                    dt,
                    first: from.0,
                    last: to.0,
                    is_seam: edge.is_seam,
                });
            }
        }
        if let (Some(period), None, false) = (form.s, form.t, has_pole) {
            let own = chart.segments.iter().filter(|segment| !segment.is_seam);
            let turn: f64 = own.map(|segment| segment.ds - shear * segment.dt).sum();
            chart.bottom = whole(turn / period).map(|turns| -turns);
            if chart.bottom.is_none() {
                return Err(ShapeFault::Orientation {
                    edge: edges.first().map_or(0, |edge| edge.id),
                });
            }
        }
        Ok(chart)
    }

    /// Returns a distance along t by which the line where a closed surface begins is moved away
    /// from vertices, which are often there.
    fn offset(&self) -> f64 {
        self.form.t.map_or(0.0, |period| 0.117_31 * period)
    }

    /// Checks the numbers on both sides of each segment of each edge.
    pub(crate) fn check(&mut self, edges: &[FaceEdge<'_>]) -> Result<(), ShapeFault> {
        // The place at the top is outside, unless the surface has no border there.
        let mut is_base_known = !(self.form.has_top_pole || self.form.t.is_some());
        let order = edges.iter().enumerate();
        let (own, seams): (Vec<_>, Vec<_>) = order.partition(|(_, edge)| !edge.is_seam);
        for (number, edge) in own.into_iter().chain(seams) {
            let fault = ShapeFault::Orientation { edge: edge.id };
            let tried = self.tried(number);
            if tried.is_empty() {
                return Err(fault);
            }
            for at in tried {
                let Some(segment) = self.segments.get(at).copied() else {
                    continue;
                };
                let (s, t) = (
                    segment.s + segment.ds * TRIED,
                    segment.t + segment.dt * TRIED,
                );
                let above = self.number((s, t), Some(at));
                let expected = i64::from(segment.is_seam || segment.ds > 0.0);
                if !is_base_known {
                    self.base += expected - above;
                    is_base_known = true;
                } else if above != expected {
                    return Err(fault);
                }
            }
        }
        self.check_crossings(edges)?;
        if let Some(bottom) = self.bottom {
            let bottom = bottom + self.base;
            let most = i64::from(self.form.has_bottom_pole);
            let is_top_wrong = self.form.has_top_pole && !(0..=1).contains(&self.base);
            if !(0..=most).contains(&bottom) || is_top_wrong {
                return Err(ShapeFault::Orientation {
                    edge: edges.first().map_or(0, |edge| edge.id),
                });
            }
            self.bottom = Some(bottom);
        }
        Ok(())
    }

    /// Returns the segments of an edge that are not vertical.
    fn tried(&self, edge: usize) -> Vec<usize> {
        let width = self.form.s.unwrap_or(1.0).abs();
        self.segments
            .iter()
            .enumerate()
            .filter(|(_, segment)| segment.edge == edge && segment.ds.abs() > width * 1e-12)
            .map(|(at, _)| at)
            .collect()
    }

    /// Checks that no two segments cross each other, which the numbers beside them may not show.
    fn check_crossings(&self, edges: &[FaceEdge<'_>]) -> Result<(), ShapeFault> {
        for (at, a) in self.segments.iter().enumerate() {
            for b in self.segments.iter().skip(at + 1) {
                if !(a.is_seam && b.is_seam) && a.crosses(b, self.form) {
                    return Err(ShapeFault::Orientation {
                        edge: edges.get(b.edge).map_or(0, |edge| edge.id),
                    });
                }
            }
        }
        Ok(())
    }

    /// Returns the number of the place above a point. The segment of the point is skipped.
    fn number(&self, (s, t): (f64, f64), skipped: Option<usize>) -> i64 {
        let t = within(t, self.form.t);
        let mut number = self.base;
        for (at, segment) in self.segments.iter().enumerate() {
            if segment.is_seam {
                continue;
            }
            if skipped != Some(at) && segment.is_above((s, t), self.form) {
                number -= if segment.ds > 0.0 { 1 } else { -1 };
            }
            if let (Some(across), Some(round)) = (self.form.s, self.form.t) {
                let end = segment.t + segment.dt;
                let level = if end >= round {
                    round
                } else if end < 0.0 {
                    0.0
                } else {
                    continue;
                };
                let share = (level - segment.t) / segment.dt;
                let crossed = within(segment.s + share * segment.ds, Some(across));
                if crossed > within(s, Some(across)) {
                    number += if segment.dt > 0.0 { 1 } else { -1 };
                }
            }
        }
        number
    }

    /// Returns the number of comparisons of a point with the edges.
    pub(crate) fn cost(&self) -> u64 {
        u64::try_from(self.segments.len()).map_or(u64::MAX, |cost| cost.saturating_add(50))
    }

    /// Returns whether all points of the surface within a radius around a point are in the face,
    /// or all outside.
    pub(crate) fn contains(
        &self,
        point: Vector,
        (s, t): (Option<f64>, f64),
        radius: f64,
    ) -> FacePlace {
        if self.is_whole {
            return FacePlace::Inside;
        }
        let own = self.segments.iter().filter(|segment| !segment.is_seam);
        let own = own.map(|segment| off_segment(point, segment.first, segment.last));
        let distance = own.fold(f64::INFINITY, f64::min);
        if distance <= radius + MARGIN {
            return FacePlace::Near(distance);
        }
        // At a pole, any s will do.
        // Beside the point, because vertices are often exactly above points of note.
        let beside = 1.371e-9 * self.form.s.unwrap_or_default();
        let s = s.unwrap_or_default() + self.shear * t + beside;
        match self.number((s, t + self.offset()), None) {
            0 => FacePlace::Outside,
            1 => FacePlace::Inside,
            _ => FacePlace::Near(distance),
        }
    }
}

impl ChartSegment {
    /// Returns whether another segment crosses this one, farther from the ends of both than edges
    /// may be from their vertices.
    fn crosses(&self, other: &Self, form: ChartForm) -> bool {
        let s = reduced(other.s - self.s, form.s);
        let t = reduced(other.t - self.t, form.t);
        if s.abs() > self.ds.abs() + other.ds.abs() || t.abs() > self.dt.abs() + other.dt.abs() {
            return false;
        }
        let determinant = self.ds * other.dt - self.dt * other.ds;
        let own = (s * other.dt - t * other.ds) / determinant;
        let others = (s * self.dt - t * self.ds) / determinant;
        let is_within = |share: f64| share > 0.0 && share < 1.0;
        if !(is_within(own) && is_within(others)) {
            return false;
        }
        let at = self.first + (self.last - self.first) * own;
        let ends = [self.first, self.last, other.first, other.last];
        ends.iter()
            .all(|end| (*end - at).length() > 2.0 * TOLERANCE)
    }

    /// Returns whether the segment crosses the way from a point to larger t.
    fn is_above(&self, (s, t): (f64, f64), form: ChartForm) -> bool {
        let (low, high) = (self.ds.min(0.0), self.ds.max(0.0));
        let mut off = s - self.s;
        if let Some(period) = form.s {
            off = low + (off - low).rem_euclid(period);
        }
        if !(off >= low && off < high) {
            return false;
        }
        within(self.t + self.dt * (off / self.ds), form.t) > t
    }
}

/// The points of an edge with their coordinates.
struct EdgeCourse {
    points: Vec<(Vector, f64, f64)>,
    has_pole: bool,
}

/// Returns the coordinates of the points of an edge, from its start to its end.
fn course(surface: &Surface, edge: &FaceEdge<'_>) -> Result<EdgeCourse, ShapeFault> {
    let mut points: Vec<(Vector, Option<f64>, f64)> = Vec::new();
    for (point, is_between) in surface.tried(&edge.span.points) {
        let at = surface.chart(point);
        // A NaN is no distance.
        if !matches!(
            at.distance.partial_cmp(&(1.5 * TOLERANCE)),
            Some(Ordering::Less)
        ) {
            let edge = edge.id;
            let distance = at.distance;
            return Err(ShapeFault::EdgeOffSurface { edge, distance });
        }
        if !is_between {
            points.push((point, at.s, at.t));
        }
    }
    let has_pole = points.iter().any(|point| point.1.is_none());
    // At a pole, an edge has the s of the point beside it.
    let known: Vec<Option<f64>> = points.iter().map(|point| point.1).collect();
    let beside = |at: usize| {
        let before = known
            .get(..at)
            .unwrap_or_default()
            .iter()
            .rev()
            .flatten()
            .next();
        let behind = known.get(at..).unwrap_or_default().iter().flatten().next();
        before.or(behind).copied().unwrap_or_default()
    };
    let points = points.iter().enumerate();
    let points = points.map(|(at, (point, s, t))| (*point, s.unwrap_or_else(|| beside(at)), *t));
    let points = points.collect();
    Ok(EdgeCourse { points, has_pole })
}

/// Returns a difference as the shortest way around.
fn reduced(difference: f64, period: Option<f64>) -> f64 {
    match period {
        Some(period) => difference - period * (difference / period).round(),
        None => difference,
    }
}

/// Returns a coordinate from 0 to its period.
fn within(value: f64, period: Option<f64>) -> f64 {
    period.map_or(value, |period| value.rem_euclid(period))
}

/// Returns a number that is whole up to a tenth, if it is small.
fn whole(number: f64) -> Option<i64> {
    let turns = (-8..=8).find(|turns: &i32| (number - f64::from(*turns)).abs() < 0.1);
    turns.map(i64::from)
}

/// The share of a segment at which its sides are compared. Halves are often above vertices.
const TRIED: f64 = 0.437_21;
/// Distance in millimetres from edges within which the place of a point is not certain. It is
/// larger than the tolerances of edges.
const MARGIN: f64 = 0.016;
