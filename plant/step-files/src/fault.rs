//! Reasons why no extent is stated.

use crate::spline::SplineFault;

/// Reason why the extents of a shape are not proven.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ShapeFault {
    /// A record is missing.
    #[error("the file has no #{0}")]
    Missing(u64),
    /// A record is not of the expected kind.
    #[error("it is {found}, which is not supported here; expected {wanted}")]
    Kind {
        /// The entities of the record.
        found: String,
        /// The expected entities.
        wanted: &'static str,
    },
    /// A parameter of a record is not of the expected kind.
    #[error("parameter {number} of {entity} is not {wanted}")]
    Parameter {
        /// The entity.
        entity: &'static str,
        /// The number of the parameter, from 1.
        number: usize,
        /// The expected kind.
        wanted: &'static str,
    },
    /// A coordinate is beyond a kilometre, or not finite.
    #[error("a coordinate or length is beyond 1000 m")]
    Coordinate,
    /// A direction has the length zero, or is parallel to the axis.
    #[error("a direction is zero or parallel to its axis")]
    NoDirection,
    /// A radius is not positive, or a torus meets itself.
    #[error("its radius of {radius} mm is not supported")]
    Radius {
        /// The radius in millimetres.
        radius: f64,
    },
    /// The half angle of a cone is not between 0 and 90 degrees.
    #[error("its half angle is not between 0 and 90 degrees")]
    ConeAngle,
    /// A B-spline is wrong.
    #[error("{0}")]
    Spline(#[from] SplineFault),
    /// The curve of an extrusion or a revolution has several pieces.
    #[error(
        "the curve of a surface has {0} pieces, so that edges on the surface are not certain; one is supported"
    )]
    Pieces(usize),
    /// A vertex is not on its curve.
    #[error("a vertex is {distance:.3} mm off the curve")]
    VertexOffCurve {
        /// The distance in millimetres.
        distance: f64,
    },
    /// A line or an open curve has one vertex for both ends.
    #[error("both ends are the same point, but the curve is not closed")]
    ClosedLine,
    /// An arc is so short that its direction is not certain.
    #[error("its ends are only {length:.4} mm apart, so that its course is not certain")]
    ShortArc {
        /// The distance of the ends in millimetres.
        length: f64,
    },
    /// The sense of an edge contradicts its vertices.
    #[error("its same_sense contradicts the order of its vertices")]
    SenseOfEdge,
    /// An edge leaves the surface of a face.
    #[error("edge #{edge} is {distance:.3} mm off its surface")]
    EdgeOffSurface {
        /// The edge.
        edge: u64,
        /// The distance in millimetres.
        distance: f64,
    },
    /// An edge is not used by two faces in opposite directions.
    #[error("{0}")]
    EdgeUse(EdgeUse),
    /// A loop is not closed.
    #[error("edge #{edge} does not begin where the edge before it ends")]
    OpenLoop {
        /// The edge.
        edge: u64,
    },
    /// The edges of a face do not enclose it.
    #[error(
        "its edges do not enclose it on their left (at edge #{edge}); a sense is wrong, or edges cross"
    )]
    Orientation {
        /// The edge.
        edge: u64,
    },
    /// A face uses an edge in both directions, although its surface is not closed.
    #[error("it uses edge #{edge} in both directions, but its surface has no seam")]
    Slit {
        /// The edge.
        edge: u64,
    },
    /// No edge bounds a face of an infinite surface.
    #[error("its edges do not bound it: the surface goes on without end")]
    Unbounded,
    /// The outside of an extreme point is inside of the solid.
    #[error("it is an outermost face, but its normal points inwards; a same_sense is wrong")]
    Inward,
    /// Two faces lie on each other.
    #[error("the faces beside it lie on each other; a same_sense is wrong")]
    Fold,
    /// A list has no members.
    #[error("it has no {0}")]
    Empty(&'static str),
    /// A limit is exceeded.
    #[error("it is too large or too detailed to be checked")]
    TooLarge,
    /// The time of the reading is over.
    #[error("the time to read the file was over before it was checked")]
    Late,
    /// The bounds of an extent are too far apart.
    #[error("the extent along {axis} is certain only within {gap:.3} mm")]
    Gap {
        /// `x`, `y` or `z`.
        axis: char,
        /// The distance of the bounds in millimetres.
        gap: f64,
    },
    /// A void is outside of its solid.
    #[error("the void is not within the solid")]
    Void,
    /// No unit of length, or several.
    #[error("its context has {0} units of length; exactly one is expected")]
    Units(usize),
    /// A unit is not known.
    #[error("the unit is not a metre with a prefix, a radian, or a multiple of them")]
    Unit,
    /// The context of a cone has no unit of angles.
    #[error("its context has no unit of angles, so that its half angle is not certain")]
    NoAngleUnit,
    /// Representations of one shape have different contexts.
    #[error("it relates representations with different contexts, whose units may differ")]
    Contexts,
    /// A shape is related to that of another product without a placement.
    #[error("its shape is also that of #{0}, or related to it without a placement")]
    OtherProduct(u64),
    /// A part or a shape is related in a way that is not read, so that it may be missing.
    #[error("{0} is not read, so that a part or a shape may be missing")]
    Unread(String),
    /// A product has no shape.
    #[error("the product has no shape")]
    NoShape,
    /// A product is a part of itself.
    #[error("the product contains itself")]
    Cycle,
    /// An occurrence has no placement, or several.
    #[error("the occurrence has {0} placements; exactly one is expected")]
    Placements(usize),
    /// A placement does not relate the shapes of an assembly and its part.
    #[error("the placement does not relate the shape of the part to that of the assembly")]
    Unrelated,
    /// A part of the assembly has no extents.
    #[error("its part #{0} has no proven extents")]
    OfPart(u64),
}

/// The use of an edge by the faces of a shell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum EdgeUse {
    /// Used once: the shell is open.
    #[error("one face uses it, so that the shell is open; a face is missing")]
    Once,
    /// Used more than twice.
    #[error("{0} faces use it, where a solid has two")]
    Often(usize),
    /// Used twice in the same direction.
    #[error("two faces use it in the same direction; an orientation is wrong")]
    SameDirection,
}
