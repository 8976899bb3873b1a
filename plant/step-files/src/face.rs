//! Faces: whether their edges enclose them, and the extremes within them.
//!
//! A face is the part of its surface to the left of its edges, seen from the side to which its
//! normal points. The number of a place is the sum of the windings of the edges around it. It is 1
//! within the face and 0 outside; any other number refutes the face.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use crate::chart::{FaceChart, FaceEdge, FacePlace};
use crate::edge::{Bounds, MOST_STEPS, NARROW};
use crate::fault::ShapeFault;
use crate::spline::{BezierCurve, BezierPatch, cost_of};
use crate::surface::{PatchGrid, ProfileCurve, Surface};
use crate::vector::{Placement, Vector};
use crate::work::{ReadingBudget, steps_of};

/// A face whose edges enclose it.
#[derive(Debug)]
pub(crate) struct CheckedFace {
    surface: Surface,
    /// Whether the normal of the face is that of the surface.
    is_outward: bool,
    chart: FaceChart,
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
        work: &mut ReadingBudget<'_>,
    ) -> Result<Self, ShapeFault> {
        let form = surface.form();
        if form.s.is_none() && form.t.is_none() {
            // A surface that is open has no seam, so that such an edge is a slit.
            if let Some(edge) = edges.iter().find(|edge| edge.is_seam) {
                return Err(ShapeFault::Slit { edge: edge.id });
            }
        }
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
        work.spend(steps_of(count).saturating_mul(surface.cost()))?;
        let mut chart = FaceChart::new(&surface, is_outward, edges)?;
        let count = chart.segments.len();
        work.spend(steps_of(count.saturating_mul(count).saturating_mul(2)))?;
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
    pub(crate) fn inner(
        &self,
        direction: Vector,
        reached: f64,
        work: &mut ReadingBudget<'_>,
    ) -> InnerExtreme {
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
            FacePlace::Inside => bounds = Bounds::exact(value),
            FacePlace::Outside => {}
            // The value is not above that of the edge by more than their distance.
            FacePlace::Near(_) => bounds.limit = value,
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
        work: &mut ReadingBudget<'_>,
    ) -> InnerExtreme {
        let value = |point: Vector| point.dot(direction);
        let ranked = |patch: BezierPatch| (patch.most(value), patch);
        let mut search = Search::new(grid.patches.iter().cloned().map(ranked), reached);
        while let Some(Ranked { most, piece }) = search.next(work.is_left()) {
            let of_patch = cost_of(&[piece.cost(), 8]);
            work.add(self.chart.cost().saturating_add(of_patch));
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
        work: &mut ReadingBudget<'_>,
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
        while let Some(Ranked { most, piece }) = search.next(work.is_left()) {
            let of_search = self.surface.cost();
            work.add(self.chart.cost().saturating_add(of_search));
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

    /// Counts the work of some normals.
    ///
    /// # Errors
    /// The reading has to end.
    pub(crate) fn count_normals(
        &self,
        count: u64,
        work: &mut ReadingBudget<'_>,
    ) -> Result<(), ShapeFault> {
        work.spend(self.surface.cost().saturating_mul(count))
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
    membership: FacePlace,
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
            FacePlace::Outside => return false,
            FacePlace::Inside => {
                if probe.value > self.best {
                    self.best = probe.value;
                    self.found.bounds.reached = probe.value;
                    self.found.is_inward = probe.is_inward;
                }
            }
            FacePlace::Near(distance) => {
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

/// The largest uncertainty in millimetres of pieces near edges.
const NEAR_EDGE: f64 = 0.03;
