//! STEP files (ISO 10303-21 with AP203, AP214 and AP242): products, assemblies and extents.
//!
//! [`StepProducts::read`] returns the products of a file with the box around each of them. A box is
//! stated only if it is proven: points that are certainly on the solid reach it, and nothing of the
//! solid exceeds it. Otherwise the product has a [`StepFinding`] with the number of the face or
//! edge and the reason.
//!
//! The proof of a solid has these steps:
//!
//! 1. Each edge is used by two faces, in opposite directions; each loop is closed.
//! 2. Each vertex is on its curves, and each edge on the surfaces of both its faces.
//! 3. The edges of each face enclose it on their left, seen against its normal. A sense that is
//!    wrong, or a missing loop, contradicts this on one of the faces of the edge.
//! 4. The largest value in a direction is on an edge or within a face. It is within a face only at
//!    the tip of a cone, or at extremes of spheres, tori, B-spline surfaces and surfaces of
//!    revolution; these count if they are in the face by step 3. B-splines are bounded by their
//!    control points, after subdivision.
//!
//! Curves and surfaces of other kinds, open shells and tessellated shapes have findings. This crate
//! opens no file. The size, depth and work of a file are bounded.
//!
//! Reading order: `part21` and `strings` (text), `records` and `units` (parameters), `vector`,
//! `spline`, `edge`, `surface` and `geometry` (curves and surfaces), `work` (limits), `chart`,
//! `face` and `solid` (the proof), `structure` and `product` (assemblies).

mod chart;
mod edge;
mod face;
mod fault;
mod geometry;
mod part21;
mod product;
mod records;
mod solid;
mod spline;
mod strings;
mod structure;
mod surface;
mod units;
mod vector;
mod work;

pub use fault::{EdgeUse, ShapeFault};
pub use part21::StepFault;
pub use product::{
    OccurrencePose, ProductExtents, ProductOccurrence, StepFinding, StepProduct, StepProducts,
};
pub use spline::SplineFault;
