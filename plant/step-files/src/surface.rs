//! Surfaces of faces, with two coordinates on each.

use std::f64::consts::TAU;
use std::rc::Rc;

use crate::edge::TOLERANCE;
use crate::fault::ShapeFault;
use crate::spline::{BezierCurve, BezierPatch, OF_SEARCH, SplineSurface, f64_of, nearest_of};
use crate::vector::{Placement, Vector};
use crate::work::ReadingBudget;

/// A surface.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Surface {
    Plane(Placement),
    Cylinder {
        placement: Placement,
        radius: f64,
    },
    /// A cone with its radius at the origin, which grows by `slope` along z.
    Cone {
        placement: Placement,
        radius: f64,
        slope: f64,
    },
    Sphere {
        placement: Placement,
        radius: f64,
    },
    Torus {
        placement: Placement,
        major: f64,
        minor: f64,
    },
    Spline(Rc<PatchGrid>),
    /// A curve that is moved along z of the placement.
    Extrusion {
        placement: Placement,
        profile: ProfileCurve,
    },
    /// A curve that is turned around z of the placement.
    Revolution {
        placement: Placement,
        profile: ProfileCurve,
    },
}

/// The curve of an extrusion or a revolution.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ProfileCurve {
    pub(crate) pieces: Vec<BezierCurve>,
}

/// The coordinates of a point on a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ChartPoint {
    /// `None` at a pole, where all values are the same point.
    pub(crate) s: Option<f64>,
    pub(crate) t: f64,
    /// The distance of the point from the surface in millimetres.
    pub(crate) distance: f64,
}

/// The course of the coordinates of a surface. The normal of the surface is that of s and t, in
/// this order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ChartForm {
    /// The period of s, if the surface is closed along it.
    pub(crate) s: Option<f64>,
    pub(crate) t: Option<f64>,
    /// Whether the surface ends in a point where t is least.
    pub(crate) has_bottom_pole: bool,
    /// Whether the surface ends in a point where t is largest.
    pub(crate) has_top_pole: bool,
}

impl ChartForm {
    /// Returns whether the surface has no border.
    pub(crate) fn is_closed(self) -> bool {
        self.s.is_some() && (self.t.is_some() || (self.has_bottom_pole && self.has_top_pole))
    }
}

impl ProfileCurve {
    pub(crate) fn new(pieces: Vec<BezierCurve>) -> Result<Self, ShapeFault> {
        if pieces.is_empty() {
            return Err(ShapeFault::Empty("points"));
        }
        Ok(Self { pieces })
    }

    fn ends(&self) -> (Vector, Vector) {
        let first = self
            .pieces
            .first()
            .map_or_else(Vector::default, BezierCurve::first);
        let last = self
            .pieces
            .last()
            .map_or_else(Vector::default, BezierCurve::last);
        (first, last)
    }

    fn is_ring(&self) -> bool {
        let (first, last) = self.ends();
        (first - last).length() <= TOLERANCE
    }

    /// Returns the length of the range of parameters.
    fn period(&self) -> f64 {
        let from = self.pieces.first().map_or(0.0, |piece| piece.from);
        self.pieces.last().map_or(0.0, |piece| piece.to) - from
    }

    /// Returns the parameter with the least distance, and the distance.
    fn nearest(&self, distance: &impl Fn(Vector) -> f64) -> (f64, f64) {
        nearest_of(&self.pieces, distance)
    }

    /// Returns the coordinates of a point on the curve turned around z of a placement.
    fn turned(&self, axis: &Placement, point: Vector) -> ChartPoint {
        let local = axis.local(point);
        let radius = local.x.hypot(local.y);
        let off = |at: Vector| {
            let at = axis.local(at);
            (at.x.hypot(at.y) - radius).hypot(at.z - local.z)
        };
        let (t, distance) = self.nearest(&off);
        let at = axis.local(self.at(t));
        let turn = local.y.atan2(local.x) - at.y.atan2(at.x);
        ChartPoint {
            s: (radius > TOLERANCE).then_some(turn),
            t,
            distance,
        }
    }

    /// Returns the point at a parameter, and the change of points beside it.
    fn beside(&self, parameter: f64) -> (Vector, Vector) {
        let step = self.period() * 1e-5;
        let from = self.pieces.first().map_or(0.0, |piece| piece.from);
        let (low, high) = (
            (parameter - step).max(from),
            (parameter + step).min(from + self.period()),
        );
        (self.at(parameter), self.at(high) - self.at(low))
    }

    /// Returns the point at a parameter.
    fn at(&self, parameter: f64) -> Vector {
        let piece = self.pieces.iter().find(|piece| parameter <= piece.to);
        piece
            .or_else(|| self.pieces.last())
            .map_or_else(Vector::default, |piece| {
                let share = (parameter - piece.from) / (piece.to - piece.from);
                piece.at(share.clamp(0.0, 1.0))
            })
    }
}

impl Surface {
    /// Returns the surface with other axes, if this has no effect on its points: a sphere whose
    /// poles are far from some points.
    pub(crate) fn with_poles_far_from(self, points: &[Vector]) -> Self {
        let Self::Sphere { placement, radius } = self else {
            return self;
        };
        let mut best = (f64::NEG_INFINITY, placement);
        let steps = [-1.0, -0.37, 0.21, 0.83];
        for (x, y, z) in steps
            .iter()
            .flat_map(|x| steps.iter().map(move |y| (x, y)))
            .flat_map(|(x, y)| steps.iter().map(move |z| (*x, *y, *z)))
        {
            let axis = Vector::new(x, y, z);
            let reference = Some(Vector::new(-y, z, x));
            let Some(tried) = Placement::new(placement.origin, axis, reference) else {
                continue;
            };
            let off = points.iter().map(|point| {
                let local = tried.local(*point);
                local.x.hypot(local.y)
            });
            let off = off.fold(f64::INFINITY, f64::min);
            if off > best.0 {
                best = (off, tried);
            }
        }
        Self::Sphere {
            placement: best.1,
            radius,
        }
    }

    /// Returns about the number of comparisons that the coordinates of a point need.
    pub(crate) fn cost(&self) -> u64 {
        let count = match self {
            Self::Spline(grid) => {
                let of_patch = grid.patches.first().map_or(0, BezierPatch::cost);
                grid.starts.len() + OF_SEARCH * of_patch
            }
            Self::Extrusion { profile, .. } | Self::Revolution { profile, .. } => {
                let of_pieces: usize = profile.pieces.iter().map(BezierCurve::cost).sum();
                of_pieces * OF_SEARCH
            }
            Self::Plane(_)
            | Self::Cylinder { .. }
            | Self::Cone { .. }
            | Self::Sphere { .. }
            | Self::Torus { .. } => 64,
        };
        u64::try_from(count).unwrap_or(u64::MAX)
    }

    /// Returns points of an edge at which it is compared with the surface, and whether each is
    /// between the given points. Surfaces of any form may meet an edge at regular distances only.
    pub(crate) fn tried<'p>(
        &self,
        points: &'p [Vector],
    ) -> impl Iterator<Item = (Vector, bool)> + 'p {
        let shares: &'static [f64] = match self {
            Self::Plane(_)
            | Self::Cylinder { .. }
            | Self::Cone { .. }
            | Self::Sphere { .. }
            | Self::Torus { .. } => &[],
            Self::Spline(_) | Self::Extrusion { .. } | Self::Revolution { .. } => {
                if points.len() <= FEW {
                    &[0.137, 0.382, 0.719]
                } else {
                    &[0.382]
                }
            }
        };
        let between = points.iter().zip(points.iter().skip(1));
        let between = between.flat_map(move |(a, b)| {
            shares
                .iter()
                .map(move |share| (*a + (*b - *a) * *share, true))
        });
        points.iter().map(|point| (*point, false)).chain(between)
    }

    /// Returns how the coordinates of the surface run.
    pub(crate) fn form(&self) -> ChartForm {
        let open = ChartForm {
            s: None,
            t: None,
            has_bottom_pole: false,
            has_top_pole: false,
        };
        let round = ChartForm {
            s: Some(TAU),
            ..open
        };
        match self {
            Self::Plane(_) => open,
            Self::Cylinder { .. } => round,
            Self::Cone { .. } => ChartForm {
                has_bottom_pole: true,
                ..round
            },
            Self::Sphere { .. } => ChartForm {
                has_bottom_pole: true,
                has_top_pole: true,
                ..round
            },
            Self::Torus { .. } => ChartForm {
                t: Some(TAU),
                ..round
            },
            Self::Spline(grid) => grid.form,
            Self::Extrusion { profile, .. } => ChartForm {
                s: profile.is_ring().then(|| profile.period()),
                ..open
            },
            Self::Revolution { placement, profile } => {
                let is_pole = |point: Vector| {
                    let local = placement.local(point);
                    local.x.hypot(local.y) <= TOLERANCE
                };
                let (first, last) = profile.ends();
                ChartForm {
                    t: profile.is_ring().then(|| profile.period()),
                    has_bottom_pole: is_pole(first),
                    has_top_pole: is_pole(last),
                    ..round
                }
            }
        }
    }

    /// Returns whether s and t are in the reverse order about the normal of the surface.
    pub(crate) fn is_mirrored(&self) -> bool {
        matches!(self, Self::Spline(grid) if grid.is_swapped)
    }

    /// Returns the normal at a point; `None` where it has none, such as at a tip.
    pub(crate) fn normal(&self, point: Vector) -> Option<Vector> {
        let radial = |placement: &Placement, height: f64, scale: f64| {
            let local = placement.local(point);
            let flat = Vector::new(local.x, local.y, 0.0).unit()?;
            (flat * scale + Vector::Z * height)
                .unit()
                .map(|local| placement.turned(local))
        };
        match self {
            Self::Plane(placement) => Some(placement.z),
            Self::Cylinder { placement, .. } => radial(placement, 0.0, 1.0),
            Self::Cone {
                placement, slope, ..
            } => radial(placement, -slope, 1.0),
            Self::Sphere { placement, .. } => (point - placement.origin).unit(),
            Self::Torus {
                placement, major, ..
            } => {
                let local = placement.local(point);
                let off = local.x.hypot(local.y) - major;
                radial(placement, local.z, off)
            }
            Self::Spline(grid) => {
                let (patch, u, v, _) = grid.closest(point)?;
                let (_, du, dv) = patch.at(u, v);
                du.cross(dv).unit()
            }
            Self::Extrusion { placement, profile } => {
                let (_, slope) = profile.beside(self.chart(point).s?);
                slope.cross(placement.z).unit()
            }
            Self::Revolution { placement, profile } => {
                let (at, slope) = profile.beside(self.chart(point).t);
                let (at, slope) = (placement.local(at), placement.local_direction(slope));
                let outwards = (at.x * slope.x + at.y * slope.y) / at.x.hypot(at.y);
                if slope.z.hypot(outwards) < 1e-9 {
                    return None;
                }
                radial(placement, -outwards, slope.z)
            }
        }
    }

    /// Returns the coordinates of a point.
    pub(crate) fn chart(&self, point: Vector) -> ChartPoint {
        match self {
            Self::Plane(placement) => {
                let local = placement.local(point);
                ChartPoint {
                    s: Some(local.x),
                    t: local.y,
                    distance: local.z.abs(),
                }
            }
            Self::Cylinder { placement, radius } => {
                let local = placement.local(point);
                ChartPoint {
                    s: Some(local.y.atan2(local.x)),
                    t: local.z,
                    distance: (local.x.hypot(local.y) - radius).abs(),
                }
            }
            Self::Cone {
                placement,
                radius,
                slope,
            } => {
                let local = placement.local(point);
                let (flat, expected) = (local.x.hypot(local.y), radius + local.z * slope);
                // Behind the apex is another cone.
                let distance = if expected < 0.0 {
                    flat.hypot(local.z + radius / slope)
                } else {
                    (flat - expected).abs() / slope.hypot(1.0)
                };
                ChartPoint {
                    s: (flat > TOLERANCE).then(|| local.y.atan2(local.x)),
                    t: local.z,
                    distance,
                }
            }
            Self::Sphere { placement, radius } => {
                let local = placement.local(point);
                let flat = local.x.hypot(local.y);
                ChartPoint {
                    s: (flat > TOLERANCE).then(|| local.y.atan2(local.x)),
                    t: local.z.atan2(flat),
                    distance: (local.length() - radius).abs(),
                }
            }
            Self::Torus {
                placement,
                major,
                minor,
            } => {
                let local = placement.local(point);
                let off = local.x.hypot(local.y) - major;
                ChartPoint {
                    s: Some(local.y.atan2(local.x)),
                    t: local.z.atan2(off),
                    distance: (off.hypot(local.z) - minor).abs(),
                }
            }
            Self::Spline(grid) => grid.chart(point),
            Self::Extrusion { placement, profile } => {
                let flat = |at: Vector| {
                    let local = placement.local_direction(at - point);
                    local.x.hypot(local.y)
                };
                let (s, distance) = profile.nearest(&flat);
                let t = placement.local_direction(point - profile.at(s)).z;
                ChartPoint {
                    s: Some(s),
                    t,
                    distance,
                }
            }
            Self::Revolution { placement, profile } => profile.turned(placement, point),
        }
    }
}

/// The patches of a B-spline surface, with points to begin searches at.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PatchGrid {
    pub(crate) patches: Vec<BezierPatch>,
    /// Points of the patches: the number of the patch, both shares and the point.
    starts: Vec<(usize, f64, f64, Vector)>,
    form: ChartForm,
    /// Whether s is v: the surface is closed along v only, or ends in a point along u.
    is_swapped: bool,
}

impl PatchGrid {
    pub(crate) fn new(
        surface: &SplineSurface,
        work: &mut ReadingBudget<'_>,
    ) -> Result<Self, ShapeFault> {
        let (count, cost) = surface.size();
        work.spend(cost)?;
        if count > MOST_PATCHES {
            return Err(ShapeFault::TooLarge);
        }
        let patches = surface.patches();
        let mut starts = Vec::new();
        for (number, patch) in patches.iter().enumerate() {
            let (of_u, of_v) = patch.degrees();
            let (of_u, of_v) = (shares(of_u), shares(of_v));
            for (u, v) in of_u.iter().flat_map(|u| of_v.iter().map(move |v| (*u, *v))) {
                starts.push((number, u, v, patch.at(u, v).0));
            }
            if starts.len() > MOST_STARTS {
                return Err(ShapeFault::TooLarge);
            }
        }
        let ((u0, u1), (v0, v1)) = surface.domain();
        let side = |is_side: &dyn Fn(&BezierPatch) -> Option<bool>| -> Vec<Vector> {
            let of_patch = |patch: &BezierPatch| {
                let along_u = is_side(patch)?;
                let points = SHARES.iter().map(|at| match along_u {
                    true => patch.at(*at, 0.0).0,
                    false => patch.at(0.0, *at).0,
                });
                Some(points.collect::<Vec<Vector>>())
            };
            patches.iter().filter_map(of_patch).flatten().collect()
        };
        let end = |is_side: &dyn Fn(&BezierPatch) -> Option<bool>| -> Vec<Vector> {
            let of_patch = |patch: &BezierPatch| {
                let along_u = is_side(patch)?;
                let points = SHARES.iter().map(|at| match along_u {
                    true => patch.at(*at, 1.0).0,
                    false => patch.at(1.0, *at).0,
                });
                Some(points.collect::<Vec<Vector>>())
            };
            patches.iter().filter_map(of_patch).flatten().collect()
        };
        let left = side(&|patch| (patch.u.0 <= u0).then_some(false));
        let right = end(&|patch| (patch.u.1 >= u1).then_some(false));
        let bottom = side(&|patch| (patch.v.0 <= v0).then_some(true));
        let top = end(&|patch| (patch.v.1 >= v1).then_some(true));
        let is_same = |a: &[Vector], b: &[Vector]| {
            a.len() == b.len()
                && a.iter()
                    .zip(b)
                    .all(|(a, b)| (*a - *b).length() <= TOLERANCE)
        };
        let is_point = |side: &[Vector]| {
            let first = side.first().copied().unwrap_or_default();
            side.iter()
                .all(|point| (*point - first).length() <= TOLERANCE)
        };
        let (closed_u, closed_v) = (is_same(&left, &right), is_same(&bottom, &top));
        let is_swapped = !closed_u && (closed_v || is_point(&left) || is_point(&right));
        let form = if is_swapped {
            ChartForm {
                s: closed_v.then_some(v1 - v0),
                t: closed_u.then_some(u1 - u0),
                has_bottom_pole: is_point(&left),
                has_top_pole: is_point(&right),
            }
        } else {
            ChartForm {
                s: closed_u.then_some(u1 - u0),
                t: closed_v.then_some(v1 - v0),
                has_bottom_pole: is_point(&bottom),
                has_top_pole: is_point(&top),
            }
        };
        Ok(Self {
            patches,
            starts,
            form,
            is_swapped,
        })
    }

    /// Returns s and t for the parameters u and v.
    pub(crate) fn coordinates(&self, u: f64, v: f64) -> (f64, f64) {
        if self.is_swapped { (v, u) } else { (u, v) }
    }

    /// Returns the coordinates of the nearest point of the surface.
    fn chart(&self, point: Vector) -> ChartPoint {
        let Some((patch, u, v, distance)) = self.closest(point) else {
            return ChartPoint {
                s: None,
                t: 0.0,
                distance: f64::INFINITY,
            };
        };
        let (_, du, dv) = patch.at(u, v);
        let of = |(from, to): (f64, f64), share: f64| from + (to - from) * share;
        let (s, t) = self.coordinates(of(patch.u, u), of(patch.v, v));
        let along = if self.is_swapped { dv } else { du };
        ChartPoint {
            s: (along.length() > TOLERANCE).then_some(s),
            t,
            distance,
        }
    }

    /// Finds the nearest point: its patch, both shares and the distance.
    fn closest(&self, point: Vector) -> Option<(&BezierPatch, f64, f64, f64)> {
        // Several starts, because points of a seam and of the borders of patches are equally near.
        let mut starts: Vec<(f64, usize, f64, f64)> = Vec::new();
        for (number, u, v, start) in &self.starts {
            let found = ((*start - point).length(), *number, *u, *v);
            if starts.len() < TRIED {
                starts.push(found);
            } else if let Some(worst) = starts.iter_mut().max_by(|a, b| a.0.total_cmp(&b.0))
                && found.0 < worst.0
            {
                *worst = found;
            }
        }
        starts.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut best: Option<(&BezierPatch, f64, f64, f64)> = None;
        for (_, number, u, v) in starts {
            if best.is_some_and(|best| best.3 < TOLERANCE / 100.0) {
                break;
            }
            let Some(patch) = self.patches.get(number) else {
                continue;
            };
            let (u, v) = nearest(patch, point, (u, v));
            let distance = (patch.at(u, v).0 - point).length();
            if best.is_none_or(|best| distance < best.3) {
                best = Some((patch, u, v, distance));
            }
        }
        best
    }
}

/// Returns shares of a patch at which searches begin: several in each turn that a curve of a degree
/// can have.
fn shares(degree: usize) -> Vec<f64> {
    let count = (2 * degree).clamp(4, 32);
    let count_f = f64_of(count);
    (0..=count).map(|at| f64_of(at) / count_f).collect()
}

/// Finds the shares of the nearest point of a patch by the method of Gauss and Newton.
fn nearest(patch: &BezierPatch, point: Vector, (mut u, mut v): (f64, f64)) -> (f64, f64) {
    for _ in 0..ROUNDS {
        let (on, du, dv) = patch.at(u, v);
        let off = point - on;
        let (a, b, c) = (du.dot(du), du.dot(dv), dv.dot(dv));
        let (e, f) = (off.dot(du), off.dot(dv));
        let determinant = a * c - b * b;
        let alone = |slope: f64, square: f64| if square > 1e-18 { slope / square } else { 0.0 };
        let (mut by_u, mut by_v) = if determinant > 1e-9 * a * c && determinant > 0.0 {
            ((e * c - f * b) / determinant, (f * a - e * b) / determinant)
        } else {
            (alone(e, a), alone(f, c))
        };
        // At a border that the step would cross, only the other share changes.
        let is_out = |at: f64, by: f64| (at <= 0.0 && by < 0.0) || (at >= 1.0 && by > 0.0);
        if is_out(u, by_u) {
            (by_u, by_v) = (0.0, alone(f, c));
        } else if is_out(v, by_v) {
            (by_u, by_v) = (alone(e, a), 0.0);
        }
        let (mut next_u, mut next_v);
        let mut part = 1.0;
        loop {
            next_u = (u + by_u * part).clamp(0.0, 1.0);
            next_v = (v + by_v * part).clamp(0.0, 1.0);
            // A step that leads away was too long.
            if (patch.at(next_u, next_v).0 - point).length() <= off.length() || part < 1e-3 {
                break;
            }
            part /= 4.0;
        }
        let change = (next_u - u).abs().max((next_v - v).abs());
        (u, v) = (next_u, next_v);
        if change < 1e-12 {
            break;
        }
    }
    (u, v)
}

/// Shares of a border at which borders are compared.
const SHARES: [f64; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];
/// Number of points up to which more points between them are compared.
const FEW: usize = 64;
/// Number of points at which the nearest point is searched.
const TRIED: usize = 8;
/// Maximum number of steps of a search.
const ROUNDS: u32 = 30;
/// Maximum number of points at which searches begin.
const MOST_STARTS: usize = 200_000;
/// Maximum number of patches of a surface.
const MOST_PATCHES: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_off_a_surface_have_their_distance() {
        let placement = Placement::IDENTITY;
        let radius = 5.0;
        for (surface, point, distance) in [
            (Surface::Plane(placement), Vector::new(1.0, 2.0, -3.0), 3.0),
            (
                Surface::Cylinder { placement, radius },
                Vector::new(0.0, 6.5, 9.0),
                1.5,
            ),
            (
                Surface::Sphere { placement, radius },
                Vector::new(0.0, 3.0, 0.0),
                2.0,
            ),
            (
                Surface::Torus {
                    placement,
                    major: 5.0,
                    minor: 1.0,
                },
                Vector::new(5.0, 0.0, 3.0),
                2.0,
            ),
            (
                Surface::Cone {
                    placement,
                    radius,
                    slope: 1.0,
                },
                Vector::new(5.0 + 2.0_f64.sqrt(), 0.0, 0.0),
                1.0,
            ),
        ] {
            let found = surface.chart(point).distance;
            assert!((found - distance).abs() < 1e-9, "{surface:?} {found}");
        }
    }
}
