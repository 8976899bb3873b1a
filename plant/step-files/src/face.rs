//! Faces: whether their edges enclose them, and the extremes within them.
//!
//! A face is the part of its surface to the left of its edges, seen from the side to which its
//! normal points. The number of a place is the sum of the windings of the edges around it. It is 1
//! within the face and 0 outside; any other number refutes the face.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use crate::edge::{Bounds, EdgeSpan, MOST_STEPS, NARROW, TOLERANCE};
use crate::fault::ShapeFault;
use crate::spline::{BezierCurve, BezierPatch, off_segment};
use crate::surface::{ChartForm, PatchGrid, ProfileCurve, Surface};
use crate::vector::{Placement, Vector};

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

/// A face whose edges enclose it.
#[derive(Debug)]
pub(crate) struct CheckedFace {
    surface: Surface,
    /// Whether the normal of the face is that of the surface.
    is_outward: bool,
    chart: Chart,
    /// The apex of a cone, if it is within the face.
    apex: Option<Vector>,
}

/// Bounds of the extremes within a face.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct InnerExtreme {
    pub(crate) bounds: Bounds,
    /// Whether the normal of the face points against the direction at the extreme.
    pub(crate) is_inward: bool,
}

impl InnerExtreme {
    const NONE: Self = Self {
        bounds: Bounds::NONE,
        is_inward: false,
    };
}

impl CheckedFace {
    /// Checks that edges are on a surface and enclose a face.
    ///
    /// # Errors
    /// The first reason why they do not.
    pub(crate) fn new(
        surface: Surface,
        is_outward: bool,
        edges: &[FaceEdge<'_>],
        work: &mut u64,
    ) -> Result<Self, ShapeFault> {
        let points: Vec<Vector> = edges
            .iter()
            .filter(|edge| !edge.is_seam)
            .flat_map(|edge| edge.span.points.iter().copied())
            .collect();
        let surface = surface.with_poles_far_from(&points);
        let count = edges
            .iter()
            .map(|edge| surface.tried(&edge.span.points).count())
            .sum::<usize>();
        let most =
            u64::try_from(count).map_or(u64::MAX, |count| count.saturating_mul(surface.cost()));
        *work = work.saturating_add(most);
        if *work > MOST_WORK {
            return Err(ShapeFault::TooLarge);
        }
        let mut chart = Chart::new(&surface, is_outward, edges)?;
        let most = u64::try_from(edges.len().saturating_mul(chart.segments.len()));
        *work = work.saturating_add(most.unwrap_or(u64::MAX));
        if *work > MOST_WORK {
            return Err(ShapeFault::TooLarge);
        }
        let form = surface.form();
        let is_whole = chart.segments.iter().all(|segment| segment.is_seam);
        if is_whole && !form.is_closed() {
            return Err(ShapeFault::Unbounded);
        }
        chart.is_whole = is_whole;
        if !is_whole {
            chart.check(edges)?;
        }
        let apex = if let Surface::Cone {
            placement,
            radius,
            slope,
        } = &surface
            && chart.bottom == Some(1)
        {
            Some(placement.point(Vector::new(0.0, 0.0, -radius / slope)))
        } else {
            None
        };
        Ok(Self {
            surface,
            is_outward,
            chart,
            apex,
        })
    }

    /// Returns bounds of the largest values in a direction of length 1 within the face, above a
    /// value that edges reach.
    pub(crate) fn inner(&self, direction: Vector, reached: f64, work: &mut u64) -> InnerExtreme {
        match &self.surface {
            // A straight line goes through each point, so that the extremes are on edges.
            Surface::Plane(_) | Surface::Cylinder { .. } | Surface::Extrusion { .. } => {
                InnerExtreme::NONE
            }
            Surface::Cone { .. } => match self.apex {
                Some(apex) => InnerExtreme {
                    bounds: Bounds::exact(apex.dot(direction)),
                    is_inward: false,
                },
                None => InnerExtreme::NONE,
            },
            Surface::Sphere { placement, radius } => {
                self.at_point(placement.origin + direction * *radius, direction)
            }
            Surface::Torus {
                placement,
                major,
                minor,
            } => {
                let local = placement.local_direction(direction);
                // Along the axis, a circle is the extreme, and any point of it decides: if an edge
                // crosses the circle, the edge is as high.
                let flat = Vector::new(local.x, local.y, 0.0).unit();
                let flat = flat.unwrap_or(Vector::new(0.6, 0.8, 0.0));
                let centre = placement.point(flat * *major);
                self.at_point(centre + direction * *minor, direction)
            }
            Surface::Spline(grid) => self.of_patches(grid, (direction, reached), work),
            Surface::Revolution { placement, profile } => {
                self.of_profile((placement, profile), (direction, reached), work)
            }
        }
    }

    /// Returns the bounds of an extreme at a point of the surface.
    fn at_point(&self, point: Vector, direction: Vector) -> InnerExtreme {
        let value = point.dot(direction);
        let at = self.surface.chart(point);
        let mut bounds = Bounds::NONE;
        match self.chart.contains(point, (at.s, at.t), 0.0) {
            Membership::Inside => bounds = Bounds::exact(value),
            Membership::Outside => {}
            // The value is not above that of the edge by more than their distance.
            Membership::Near(_) => bounds.limit = value,
        }
        InnerExtreme {
            bounds,
            is_inward: !self.is_outward,
        }
    }

    /// Searches the patches of a B-spline surface.
    fn of_patches(
        &self,
        grid: &PatchGrid,
        (direction, reached): (Vector, f64),
        work: &mut u64,
    ) -> InnerExtreme {
        let value = |point: Vector| point.dot(direction);
        let ranked = |patch: BezierPatch| (patch.most(value), patch);
        let mut search = Search::new(grid.patches.iter().cloned().map(ranked), reached);
        while let Some(Ranked { most, piece }) = search.next(*work <= MOST_WORK) {
            *work = work.saturating_add(self.chart.cost());
            let (middle, du, dv) = piece.at(0.5, 0.5);
            let (u, v) = (
                f64::midpoint(piece.u.0, piece.u.1),
                f64::midpoint(piece.v.0, piece.v.1),
            );
            let radius = piece.most(|point| (point - middle).length());
            let (s, t) = grid.coordinates(u, v);
            let probe = Probe {
                value: value(middle),
                radius,
                membership: self.chart.contains(middle, (Some(s), t), radius),
                is_inward: (du.cross(dv).dot(direction) < 0.0) == self.is_outward,
            };
            if search.goes_on(most, &probe) {
                let (low, high) = piece.halves();
                search.push([ranked(low), ranked(high)]);
            }
        }
        search.end()
    }

    /// Searches the curve of a surface of revolution, turned to where it is highest.
    fn of_profile(
        &self,
        (placement, profile): (&Placement, &ProfileCurve),
        (direction, reached): (Vector, f64),
        work: &mut u64,
    ) -> InnerExtreme {
        let local = placement.local_direction(direction);
        let flat = Vector::new(local.x, local.y, 0.0);
        let (tilt, turn) = (flat.length(), flat.unit());
        // Along the axis, circles are the extremes, and any point of each decides.
        let turn = turn.unwrap_or(Vector::new(0.6, 0.8, 0.0));
        let origin = placement.origin.dot(direction);
        let height = |point: Vector| {
            let at = placement.local(point);
            origin + at.z * local.z + at.x.hypot(at.y) * tilt
        };
        let ranked = |piece: BezierCurve| (piece.most(height), piece);
        let mut search = Search::new(profile.pieces.iter().cloned().map(ranked), reached);
        while let Some(Ranked { most, piece }) = search.next(*work <= MOST_WORK) {
            *work = work.saturating_add(self.chart.cost());
            let (low, high) = piece.split(0.5);
            let at = placement.local(low.last());
            let middle = turn * at.x.hypot(at.y) + Vector::Z * at.z;
            let middle = placement.point(middle);
            let radius = piece.most(|point| (point - low.last()).length());
            let chart = self.surface.chart(middle);
            let probe = Probe {
                value: middle.dot(direction),
                radius,
                membership: self.chart.contains(middle, (chart.s, chart.t), radius),
                is_inward: self
                    .normal(middle)
                    .is_some_and(|normal| normal.dot(direction) < 0.0),
            };
            if search.goes_on(most, &probe) {
                search.push([ranked(low), ranked(high)]);
            }
        }
        search.end()
    }

    /// Returns the normal of the face at a point; `None` where it has none.
    pub(crate) fn normal(&self, point: Vector) -> Option<Vector> {
        let normal = self.surface.normal(point)?;
        Some(if self.is_outward { normal } else { -normal })
    }

    /// Returns whether the edges enclose two places of the surface, of which the sense of the face
    /// chooses one.
    pub(crate) fn has_choice(&self) -> bool {
        let form = self.surface.form();
        (form.has_top_pole || form.t.is_some()) && !self.chart.is_whole
    }
}

/// The place of the points around a point.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Membership {
    Inside,
    Outside,
    /// The edges of the face are at this distance from the point.
    Near(f64),
}

/// A piece of a surface or a curve, by its upper bound.
struct Ranked<T> {
    most: f64,
    piece: T,
}

impl<T> PartialEq for Ranked<T> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl<T> Eq for Ranked<T> {}

impl<T> PartialOrd for Ranked<T> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl<T> Ord for Ranked<T> {
    fn cmp(&self, other: &Self) -> Ordering {
        self.most.total_cmp(&other.most)
    }
}

/// The search for the largest value of pieces, the piece with the largest bound first.
struct Search<T> {
    open: BinaryHeap<Ranked<T>>,
    /// The value that edges reach.
    edges: f64,
    /// The largest value so far.
    best: f64,
    found: InnerExtreme,
    steps: usize,
}

/// A point of a piece: its value, the largest distance of the piece from it, and its place.
struct Probe {
    value: f64,
    radius: f64,
    membership: Membership,
    is_inward: bool,
}

impl<T> Search<T> {
    fn new(pieces: impl Iterator<Item = (f64, T)>, edges: f64) -> Self {
        Self {
            open: pieces.map(|(most, piece)| Ranked { most, piece }).collect(),
            edges,
            best: edges,
            found: InnerExtreme::NONE,
            steps: 0,
        }
    }

    /// Returns the next piece that may exceed the largest value so far.
    fn next(&mut self, has_work: bool) -> Option<Ranked<T>> {
        let next = self.open.pop()?;
        if next.most <= self.best + NARROW || self.steps >= MOST_STEPS || !has_work {
            let bounds = &mut self.found.bounds;
            bounds.limit = bounds.limit.max(next.most);
            return None;
        }
        self.steps += 1;
        Some(next)
    }

    /// Takes a point of a piece into account. Returns whether the piece has to be split.
    fn goes_on(&mut self, most: f64, probe: &Probe) -> bool {
        match probe.membership {
            Membership::Outside => return false,
            Membership::Inside => {
                if probe.value > self.best {
                    self.best = probe.value;
                    self.found.bounds.reached = probe.value;
                    self.found.is_inward = probe.is_inward;
                }
            }
            Membership::Near(distance) => {
                // No point of the piece is farther from an edge than this.
                let of_edge = self.edges + NARROW + distance + probe.radius;
                if of_edge <= self.best + NEAR_EDGE {
                    let bounds = &mut self.found.bounds;
                    bounds.limit = bounds.limit.max(most.min(of_edge));
                    return false;
                }
            }
        }
        true
    }

    fn push(&mut self, pieces: [(f64, T); 2]) {
        let pieces = pieces.into_iter();
        self.open
            .extend(pieces.map(|(most, piece)| Ranked { most, piece }));
    }

    fn end(mut self) -> InnerExtreme {
        let bounds = &mut self.found.bounds;
        bounds.limit = bounds.limit.max(bounds.reached);
        self.found
    }
}

/// The edges of a face in the coordinates of its surface.
#[derive(Debug)]
struct Chart {
    form: ChartForm,
    segments: Vec<Segment>,
    /// The shear of s along t, by which straight lines of surfaces are not vertical.
    shear: f64,
    /// The number of the place that all others are counted from.
    base: i64,
    /// The number of the place where t is least, if it is certain.
    bottom: Option<i64>,
    /// Whether the face is the whole surface.
    is_whole: bool,
}

/// A short piece of an edge.
#[derive(Debug, Clone, Copy)]
struct Segment {
    /// The number of its edge in the face.
    edge: usize,
    s: f64,
    t: f64,
    ds: f64,
    dt: f64,
    first: Vector,
    last: Vector,
    is_seam: bool,
}

impl Chart {
    fn new(
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
                chart.segments.push(Segment {
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

    /// Checks the numbers on both sides of each edge.
    fn check(&mut self, edges: &[FaceEdge<'_>]) -> Result<(), ShapeFault> {
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

    /// Returns some segments of an edge that are not vertical.
    fn tried(&self, edge: usize) -> Vec<usize> {
        let width = self.form.s.unwrap_or(1.0).abs();
        let own: Vec<usize> = self
            .segments
            .iter()
            .enumerate()
            .filter(|(_, segment)| segment.edge == edge && segment.ds.abs() > width * 1e-12)
            .map(|(at, _)| at)
            .collect();
        let quarters = [1, 2, 3].map(|quarter| own.len() * quarter / 4);
        let mut all: Vec<usize> = quarters
            .iter()
            .filter_map(|at| own.get(*at).copied())
            .collect();
        all.dedup();
        all
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
    fn cost(&self) -> u64 {
        u64::try_from(self.segments.len()).map_or(u64::MAX, |cost| cost.saturating_add(50))
    }

    /// Returns whether all points of the surface within a radius around a point are in the face,
    /// or all outside.
    fn contains(&self, point: Vector, (s, t): (Option<f64>, f64), radius: f64) -> Membership {
        if self.is_whole {
            return Membership::Inside;
        }
        let own = self.segments.iter().filter(|segment| !segment.is_seam);
        let own = own.map(|segment| off_segment(point, segment.first, segment.last));
        let distance = own.fold(f64::INFINITY, f64::min);
        if distance <= radius + MARGIN {
            return Membership::Near(distance);
        }
        // At a pole, any s will do.
        // Beside the point, because vertices are often exactly above points of note.
        let beside = 1.371e-9 * self.form.s.unwrap_or_default();
        let s = s.unwrap_or_default() + self.shear * t + beside;
        match self.number((s, t + self.offset()), None) {
            0 => Membership::Outside,
            1 => Membership::Inside,
            _ => Membership::Near(distance),
        }
    }
}

impl Segment {
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
/// The largest uncertainty in millimetres of pieces near edges.
const NEAR_EDGE: f64 = 0.03;
/// Maximum number of comparisons of edges with each other, of all faces.
pub(crate) const MOST_WORK: u64 = 200_000_000;
