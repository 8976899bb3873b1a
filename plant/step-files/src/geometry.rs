//! Reads points, placements, curves and surfaces from records. Lengths become millimetres.

use std::f64::consts::FRAC_PI_2;
use std::rc::Rc;

use crate::edge::{Curve, TOLERANCE};
use crate::fault::ShapeFault;
use crate::part21::ExchangeFile;
use crate::records::{AtEntity, EntityArguments, FaultAt};
use crate::spline::{Knots, MOST_DEGREE, SplineCurve, SplineFault, SplineSurface};
use crate::surface::{PatchGrid, ProfileCurve, Surface};
use crate::units::Units;
use crate::vector::{Placement, Vector};
use crate::work::ReadingBudget;

/// Records with the units of their context.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Geometry<'f> {
    pub(crate) file: &'f ExchangeFile,
    pub(crate) units: Units,
}

impl Geometry<'_> {
    fn length(&self, arguments: &EntityArguments<'_>, at: usize) -> Result<f64, FaultAt> {
        let length = arguments.number(at)? * self.units.length;
        if length.abs() <= FARTHEST {
            Ok(length)
        } else {
            Err(ShapeFault::Coordinate).at(arguments.id)
        }
    }

    fn radius(&self, arguments: &EntityArguments<'_>, at: usize) -> Result<f64, FaultAt> {
        let radius = self.length(arguments, at)?;
        if radius > TOLERANCE {
            Ok(radius)
        } else {
            Err(ShapeFault::Radius { radius }).at(arguments.id)
        }
    }

    /// Reads the three numbers of a point or a direction.
    fn triple(&self, arguments: &EntityArguments<'_>, scale: f64) -> Result<Vector, FaultAt> {
        let numbers = arguments.numbers(1)?;
        let [x, y, z] = numbers.as_slice() else {
            let fault = ShapeFault::Parameter {
                entity: arguments.name,
                number: 2,
                wanted: "a list of three numbers",
            };
            return Err(fault).at(arguments.id);
        };
        let point = Vector::new(x * scale, y * scale, z * scale);
        let far = [point.x, point.y, point.z].map(f64::abs);
        if far.iter().all(|far| *far <= FARTHEST) {
            Ok(point)
        } else {
            Err(ShapeFault::Coordinate).at(arguments.id)
        }
    }

    pub(crate) fn point(&self, id: u64) -> Result<Vector, FaultAt> {
        let arguments = self.file.one_of(id, &["CARTESIAN_POINT"])?;
        self.triple(&arguments, self.units.length)
    }

    fn points(&self, ids: &[u64]) -> Result<Vec<Vector>, FaultAt> {
        ids.iter().map(|id| self.point(*id)).collect()
    }

    fn direction(&self, id: u64) -> Result<Vector, FaultAt> {
        let arguments = self.file.one_of(id, &["DIRECTION"])?;
        let direction = self.triple(&arguments, 1.0)?;
        direction.unit().ok_or(ShapeFault::NoDirection).at(id)
    }

    /// Reads the direction of a vector. Its length is of no matter.
    fn vector(&self, id: u64) -> Result<Vector, FaultAt> {
        let arguments = self.file.one_of(id, &["VECTOR"])?;
        let length = arguments.number(2)?;
        let direction = self.direction(arguments.reference(1)?)?;
        if length > 0.0 {
            Ok(direction)
        } else {
            Err(ShapeFault::NoDirection).at(id)
        }
    }

    pub(crate) fn placement(&self, id: u64) -> Result<Placement, FaultAt> {
        let arguments = self.file.one_of(id, &["AXIS2_PLACEMENT_3D"])?;
        let origin = self.point(arguments.reference(1)?)?;
        let optional = |at: usize| match arguments.is_omitted(at) {
            true => Ok(None),
            false => self.direction(arguments.reference(at)?).map(Some),
        };
        let (axis, reference) = (optional(2)?.unwrap_or(Vector::Z), optional(3)?);
        let placement = Placement::new(origin, axis, reference);
        placement.ok_or(ShapeFault::NoDirection).at(id)
    }

    /// Reads an axis without a direction of x.
    fn axis(&self, id: u64) -> Result<Placement, FaultAt> {
        let arguments = self.file.one_of(id, &["AXIS1_PLACEMENT"])?;
        let origin = self.point(arguments.reference(1)?)?;
        let axis = match arguments.is_omitted(2) {
            true => Vector::Z,
            false => self.direction(arguments.reference(2)?)?,
        };
        let placement = Placement::new(origin, axis, None);
        placement.ok_or(ShapeFault::NoDirection).at(id)
    }

    /// Reads the curve of an edge. Curves with curves on their surfaces are the curve in space.
    pub(crate) fn curve(&self, id: u64) -> Result<Curve, FaultAt> {
        let on_surface = ["SURFACE_CURVE", "SEAM_CURVE", "INTERSECTION_CURVE"];
        if let Ok(arguments) = self.file.one_of(id, &on_surface) {
            if !self.file.is_simple(id) {
                self.file.one_of(id, &CURVES)?;
                return Err(self.unknown(id));
            }
            return self.plain_curve(arguments.reference(1)?);
        }
        self.plain_curve(id)
    }

    fn unknown(&self, id: u64) -> FaultAt {
        FaultAt {
            entity: id,
            fault: ShapeFault::Kind {
                found: self.file.shown(id),
                wanted: "a curve or surface of its own",
            },
        }
    }

    fn plain_curve(&self, id: u64) -> Result<Curve, FaultAt> {
        let arguments = self.file.one_of(id, &CURVES)?;
        let is_spline = SPLINE_CURVES.contains(&arguments.name);
        if !is_spline && !self.file.is_simple(id) {
            return Err(self.unknown(id));
        }
        match arguments.name {
            "LINE" => Ok(Curve::Line {
                point: self.point(arguments.reference(1)?)?,
                direction: self.vector(arguments.reference(2)?)?,
            }),
            "CIRCLE" => {
                let radius = self.radius(&arguments, 2)?;
                Ok(Curve::Ellipse {
                    placement: self.placement(arguments.reference(1)?)?,
                    x: radius,
                    y: radius,
                })
            }
            "ELLIPSE" => Ok(Curve::Ellipse {
                placement: self.placement(arguments.reference(1)?)?,
                x: self.radius(&arguments, 2)?,
                y: self.radius(&arguments, 3)?,
            }),
            "POLYLINE" => {
                let points = self.points(&arguments.references(1)?)?;
                let knots = implied("QUASI_UNIFORM", 1, points.len()).at(id)?;
                SplineCurve::new(knots, &points, None)
                    .map(Curve::Spline)
                    .at(id)
            }
            _ => self.spline_curve(id).map(Curve::Spline),
        }
    }

    fn spline_curve(&self, id: u64) -> Result<SplineCurve, FaultAt> {
        let is_simple = self.file.is_simple(id);
        // In a simple instance, the name of the item is first.
        let (base, skipped) = if is_simple {
            (self.file.one_of(id, &SPLINE_CURVES)?, 1)
        } else {
            (self.file.one_of(id, &["B_SPLINE_CURVE"])?, 0)
        };
        let degree = base.integer(skipped)?;
        let points = self.points(&base.references(skipped + 1)?)?;
        let knots = match self.file.find(id, "B_SPLINE_CURVE_WITH_KNOTS") {
            Some(with) => {
                let first = if is_simple { 6 } else { 0 };
                let (times, values) = (with.integers(first)?, with.numbers(first + 1)?);
                Knots::new(degree, (&times, &values), points.len()).at(id)?
            }
            None => implied(self.kind_of_knots(id)?, degree, points.len()).at(id)?,
        };
        let weights = match self.file.find(id, "RATIONAL_B_SPLINE_CURVE") {
            Some(rational) => Some(rational.numbers(0)?),
            None => None,
        };
        SplineCurve::new(knots, &points, weights.as_deref()).at(id)
    }

    /// Returns the kind of the knots that a spline has without naming them.
    fn kind_of_knots(&self, id: u64) -> Result<&'static str, FaultAt> {
        let kinds = [
            ("QUASI_UNIFORM_CURVE", "QUASI_UNIFORM"),
            ("QUASI_UNIFORM_SURFACE", "QUASI_UNIFORM"),
            ("UNIFORM_CURVE", "UNIFORM"),
            ("UNIFORM_SURFACE", "UNIFORM"),
            ("BEZIER_CURVE", "BEZIER"),
            ("BEZIER_SURFACE", "BEZIER"),
        ];
        let kind = kinds.iter().find(|(entity, _)| self.file.is(id, entity));
        kind.map(|(_, kind)| *kind).ok_or_else(|| self.unknown(id))
    }

    pub(crate) fn surface(
        &self,
        id: u64,
        work: &mut ReadingBudget<'_>,
    ) -> Result<Surface, FaultAt> {
        let arguments = self.file.one_of(id, &SURFACES)?;
        if !SPLINE_SURFACES.contains(&arguments.name) && !self.file.is_simple(id) {
            return Err(self.unknown(id));
        }
        let placement = || self.placement(arguments.reference(1)?);
        match arguments.name {
            "PLANE" => Ok(Surface::Plane(placement()?)),
            "CYLINDRICAL_SURFACE" => Ok(Surface::Cylinder {
                placement: placement()?,
                radius: self.radius(&arguments, 2)?,
            }),
            "CONICAL_SURFACE" => {
                let (radius, angle) = (self.length(&arguments, 2)?, arguments.number(3)?);
                let unit = self.units.angle.ok_or(ShapeFault::NoAngleUnit).at(id)?;
                let angle = angle * unit;
                if radius < 0.0 {
                    return Err(ShapeFault::Radius { radius }).at(id);
                }
                if !(angle > 1e-4 && angle < FRAC_PI_2 - 1e-4) {
                    return Err(ShapeFault::ConeAngle).at(id);
                }
                Ok(Surface::Cone {
                    placement: placement()?,
                    radius,
                    slope: angle.tan(),
                })
            }
            "SPHERICAL_SURFACE" => Ok(Surface::Sphere {
                placement: placement()?,
                radius: self.radius(&arguments, 2)?,
            }),
            "TOROIDAL_SURFACE" => {
                let (major, minor) = (self.radius(&arguments, 2)?, self.radius(&arguments, 3)?);
                if major <= minor + TOLERANCE {
                    return Err(ShapeFault::Radius { radius: minor }).at(id);
                }
                Ok(Surface::Torus {
                    placement: placement()?,
                    major,
                    minor,
                })
            }
            "SURFACE_OF_LINEAR_EXTRUSION" => {
                let direction = self.vector(arguments.reference(2)?)?;
                let placement = Placement::new(Vector::default(), direction, None);
                Ok(Surface::Extrusion {
                    placement: placement.ok_or(ShapeFault::NoDirection).at(id)?,
                    profile: self.profile(arguments.reference(1)?)?,
                })
            }
            "SURFACE_OF_REVOLUTION" => Ok(Surface::Revolution {
                profile: self.profile(arguments.reference(1)?)?,
                placement: self.axis(arguments.reference(2)?)?,
            }),
            _ => self.spline_surface(id, work),
        }
    }

    /// Reads a curve with ends, or a closed one, that makes a surface.
    fn profile(&self, id: u64) -> Result<ProfileCurve, FaultAt> {
        let (spline, is_spline) = match self.curve(id)? {
            Curve::Line { .. } => return Err(self.unknown(id)),
            Curve::Ellipse { placement, x, y } => (ellipse(&placement, x, y).at(id)?, false),
            Curve::Spline(spline) => (spline, true),
        };
        let pieces = spline.pieces(spline.domain());
        if is_spline && pieces.len() > 1 {
            return Err(ShapeFault::Pieces(pieces.len())).at(id);
        }
        ProfileCurve::new(pieces).at(id)
    }

    fn spline_surface(&self, id: u64, work: &mut ReadingBudget<'_>) -> Result<Surface, FaultAt> {
        let is_simple = self.file.is_simple(id);
        let (base, skipped) = if is_simple {
            (self.file.one_of(id, &SPLINE_SURFACES)?, 1)
        } else {
            (self.file.one_of(id, &["B_SPLINE_SURFACE"])?, 0)
        };
        let (of_u, of_v) = (base.integer(skipped)?, base.integer(skipped + 1)?);
        let rows = base.reference_rows(skipped + 2)?;
        let points: Result<Vec<_>, _> = rows.iter().map(|row| self.points(row)).collect();
        let points = points?;
        let (height, width) = (points.len(), points.first().map_or(0, Vec::len));
        let (u, v) = match self.file.find(id, "B_SPLINE_SURFACE_WITH_KNOTS") {
            Some(with) => {
                let first = if is_simple { 8 } else { 0 };
                let (times_u, times_v) = (with.integers(first)?, with.integers(first + 1)?);
                let (u, v) = (with.numbers(first + 2)?, with.numbers(first + 3)?);
                (
                    Knots::new(of_u, (&times_u, &u), height).at(id)?,
                    Knots::new(of_v, (&times_v, &v), width).at(id)?,
                )
            }
            None => {
                let kind = self.kind_of_knots(id)?;
                (
                    implied(kind, of_u, height).at(id)?,
                    implied(kind, of_v, width).at(id)?,
                )
            }
        };
        let weights = match self.file.find(id, "RATIONAL_B_SPLINE_SURFACE") {
            Some(rational) => Some(rational.number_rows(0)?),
            None => None,
        };
        let surface = SplineSurface::new(u, v, &points, weights.as_deref()).at(id)?;
        let grid = PatchGrid::new(&surface, work).at(id)?;
        Ok(Surface::Spline(Rc::new(grid)))
    }
}

/// Returns the knots of splines that do not name them (ISO 10303-42, 4.4.34 to 4.4.37).
fn implied(kind: &str, degree: i64, count: usize) -> Result<Knots, SplineFault> {
    if !(1..=MOST_DEGREE).contains(&usize::try_from(degree).unwrap_or_default()) {
        return Err(SplineFault::Degree);
    }
    let points = i64::try_from(count).map_err(|_| SplineFault::Count)?;
    let (ends, inner, spans) = match kind {
        "UNIFORM" => (1, 1, points.saturating_add(degree)),
        "BEZIER" if (points - 1) % degree == 0 => (degree + 1, degree, (points - 1) / degree),
        "QUASI_UNIFORM" => (degree.saturating_add(1), 1, points.saturating_sub(degree)),
        _ => return Err(SplineFault::Count),
    };
    let spans = usize::try_from(spans).map_err(|_| SplineFault::Count)?;
    if spans == 0 || spans > count + 64 {
        return Err(SplineFault::Count);
    }
    let mut times = vec![inner; spans + 1];
    let values: Vec<f64> = (0..=spans).map(crate::spline::f64_of).collect();
    if let Some(first) = times.first_mut() {
        *first = ends;
    }
    if let Some(last) = times.last_mut() {
        *last = ends;
    }
    Knots::new(degree, (&times, &values), count)
}

/// Returns an ellipse as a rational spline of four quarters.
fn ellipse(placement: &Placement, x: f64, y: f64) -> Result<SplineCurve, SplineFault> {
    let corners = [
        (1.0, 0.0),
        (1.0, 1.0),
        (0.0, 1.0),
        (-1.0, 1.0),
        (-1.0, 0.0),
        (-1.0, -1.0),
        (0.0, -1.0),
        (1.0, -1.0),
        (1.0, 0.0),
    ];
    let points = corners.map(|(u, v)| placement.point(Vector::new(u * x, v * y, 0.0)));
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let weights = [1.0, half, 1.0, half, 1.0, half, 1.0, half, 1.0];
    let knots = Knots::new(
        2,
        (&[3, 2, 2, 2, 3], &[0.0, 1.0, 2.0, 3.0, 4.0]),
        points.len(),
    )?;
    SplineCurve::new(knots, &points, Some(&weights))
}

/// Largest coordinate in millimetres. Beyond, rounding is no longer small beside the tolerance.
const FARTHEST: f64 = 1e6;
const SPLINE_CURVES: [&str; 4] = [
    "B_SPLINE_CURVE_WITH_KNOTS",
    "QUASI_UNIFORM_CURVE",
    "UNIFORM_CURVE",
    "BEZIER_CURVE",
];
const CURVES: [&str; 8] = [
    "LINE",
    "CIRCLE",
    "ELLIPSE",
    "POLYLINE",
    "B_SPLINE_CURVE_WITH_KNOTS",
    "QUASI_UNIFORM_CURVE",
    "UNIFORM_CURVE",
    "BEZIER_CURVE",
];
const SPLINE_SURFACES: [&str; 4] = [
    "B_SPLINE_SURFACE_WITH_KNOTS",
    "QUASI_UNIFORM_SURFACE",
    "UNIFORM_SURFACE",
    "BEZIER_SURFACE",
];
const SURFACES: [&str; 11] = [
    "PLANE",
    "CYLINDRICAL_SURFACE",
    "CONICAL_SURFACE",
    "SPHERICAL_SURFACE",
    "TOROIDAL_SURFACE",
    "SURFACE_OF_LINEAR_EXTRUSION",
    "SURFACE_OF_REVOLUTION",
    "B_SPLINE_SURFACE_WITH_KNOTS",
    "QUASI_UNIFORM_SURFACE",
    "UNIFORM_SURFACE",
    "BEZIER_SURFACE",
];
