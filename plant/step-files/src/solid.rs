//! Solids: their topology, checked, and bounds of their extents.

use std::collections::HashMap;

use crate::edge::{Bounds, EdgeSpan, TOLERANCE};
use crate::face::{CheckedFace, FaceEdge, MOST_WORK};
use crate::fault::{EdgeUse, ShapeFault};
use crate::geometry::Geometry;
use crate::records::{EntityArguments, AtEntity, FaultAt};
use crate::vector::Vector;

/// A solid whose shell is closed.
#[derive(Debug)]
pub(crate) struct CheckedSolid {
    id: u64,
    edges: Vec<(u64, EdgeSpan)>,
    faces: Vec<(u64, CheckedFace)>,
}

/// An edge of the file.
struct ReadEdge {
    span: EdgeSpan,
    start: u64,
    end: u64,
}

/// A face of the file with its loops.
struct ReadFace {
    id: u64,
    is_outward: bool,
    surface: u64,
    /// The edges with their directions.
    uses: Vec<(u64, bool)>,
    /// The points that are loops of their own.
    points: Vec<u64>,
}

impl CheckedSolid {
    /// Reads a solid with its shells.
    ///
    /// # Errors
    /// The first reason why the solid is not proven to be closed.
    pub(crate) fn read(geometry: &Geometry<'_>, id: u64, work: &mut u64) -> Result<Self, FaultAt> {
        let solid = geometry.file.one_of(id, &SOLIDS)?;
        if !geometry.file.is_simple(id) {
            return Err(ShapeFault::Kind {
                found: geometry.file.shown(id),
                wanted: "MANIFOLD_SOLID_BREP",
            })
            .at(id);
        }
        let outer = Self::of_shell(geometry, (id, solid.reference(1)?), work)?;
        if solid.name == "BREP_WITH_VOIDS" {
            for void in solid.references(2)? {
                let inner = Self::of_shell(geometry, (id, void), work)?;
                for direction in AXES.iter().flat_map(|axis| [*axis, -*axis]) {
                    let of_outer = outer.bounds(direction, work)?.0;
                    let of_void = inner.bounds(direction, work)?.0;
                    if of_void.limit > of_outer.reached + TOLERANCE {
                        return Err(ShapeFault::Void).at(void);
                    }
                }
            }
        }
        Ok(outer)
    }

    fn of_shell(
        geometry: &Geometry<'_>,
        (solid, shell): (u64, u64),
        work: &mut u64,
    ) -> Result<Self, FaultAt> {
        let shell = shell_of(geometry, shell)?;
        let ids = shell.references(1)?;
        if ids.is_empty() {
            return Err(ShapeFault::Empty("faces")).at(shell.id);
        }
        let mut edges: HashMap<u64, ReadEdge> = HashMap::new();
        let mut faces = Vec::new();
        let mut seen = std::collections::HashSet::new();
        for id in ids {
            if !seen.insert(id) {
                return Err(ShapeFault::EdgeUse(EdgeUse::Often(2))).at(id);
            }
            faces.push(read_face(geometry, id, &mut edges)?);
        }
        check_uses(&faces)?;
        let mut checked = Vec::new();
        for face in &faces {
            checked.push((face.id, check_face(geometry, face, &edges, work)?));
        }
        let mut edges: Vec<(u64, EdgeSpan)> = edges
            .into_iter()
            .map(|(id, edge)| (id, edge.span))
            .collect();
        edges.sort_by_key(|(id, _)| *id);
        Ok(Self {
            id: solid,
            edges,
            faces: checked,
        })
    }

    /// Returns bounds of the largest value in a direction of length 1, and the entity that has the
    /// limit.
    ///
    /// # Errors
    /// The face at the extreme has its normal inwards.
    pub(crate) fn bounds(
        &self,
        direction: Vector,
        work: &mut u64,
    ) -> Result<(Bounds, u64), FaultAt> {
        let (mut all, mut decisive) = (Bounds::NONE, self.id);
        let count = self.edges.len() + self.faces.len();
        *work = work.saturating_add(u64::try_from(count).unwrap_or(u64::MAX));
        if *work > MOST_WORK {
            return Err(ShapeFault::TooLarge).at(self.id);
        }
        for (id, edge) in &self.edges {
            let bounds = edge.bounds(direction);
            if bounds.limit > all.limit {
                decisive = *id;
            }
            all = all.with(bounds);
        }
        let of_edges = all.reached;
        let mut inward = (f64::NEG_INFINITY, 0);
        let mut outward = of_edges;
        for (id, face) in &self.faces {
            let inner = face.inner(direction, of_edges, work);
            if inner.bounds.limit > all.limit {
                decisive = *id;
            }
            all = all.with(inner.bounds);
            if !inner.is_inward {
                outward = outward.max(inner.bounds.reached);
            } else if inner.bounds.reached > inward.0 {
                inward = (inner.bounds.reached, *id);
            }
        }
        if inward.0 > outward + 2.0 * TOLERANCE {
            return Err(ShapeFault::Inward).at(inward.1);
        }
        Ok((all, decisive))
    }
}

/// Returns the shell with its faces; an oriented shell names another one.
fn shell_of<'f>(geometry: &Geometry<'f>, id: u64) -> Result<EntityArguments<'f>, FaultAt> {
    if let Some(oriented) = geometry.file.find(id, "ORIENTED_CLOSED_SHELL") {
        return geometry.file.one_of(oriented.reference(2)?, &["CLOSED_SHELL"]);
    }
    geometry.file.one_of(id, &["CLOSED_SHELL"])
}

fn read_face(
    geometry: &Geometry<'_>,
    id: u64,
    edges: &mut HashMap<u64, ReadEdge>,
) -> Result<ReadFace, FaultAt> {
    let face = geometry.file.one_of(id, &["ADVANCED_FACE", "FACE_SURFACE"])?;
    let mut uses = Vec::new();
    let mut points = Vec::new();
    for bound in face.references(1)? {
        let bound = geometry.file.one_of(bound, &["FACE_OUTER_BOUND", "FACE_BOUND"])?;
        let (ring, is_same) = (bound.reference(1)?, bound.boolean(2)?);
        if let Some(vertex) = geometry.file.find(ring, "VERTEX_LOOP") {
            points.push(vertex.reference(1)?);
            continue;
        }
        let ring = read_loop(geometry, ring, edges)?;
        uses.extend(ring.into_iter().map(|(edge, along)| (edge, along == is_same)));
    }
    Ok(ReadFace {
        id,
        is_outward: face.boolean(3)?,
        surface: face.reference(2)?,
        uses,
        points,
    })
}

/// Reads a loop, whose edges follow each other.
fn read_loop(
    geometry: &Geometry<'_>,
    id: u64,
    edges: &mut HashMap<u64, ReadEdge>,
) -> Result<Vec<(u64, bool)>, FaultAt> {
    let ring = geometry.file.one_of(id, &["EDGE_LOOP"])?;
    let mut uses = Vec::new();
    let mut vertices: Vec<(u64, u64, u64)> = Vec::new();
    for oriented in ring.references(1)? {
        let oriented = geometry.file.one_of(oriented, &["ORIENTED_EDGE"])?;
        let (edge, along) = (oriented.reference(3)?, oriented.boolean(4)?);
        if !edges.contains_key(&edge) {
            edges.insert(edge, read_edge(geometry, edge)?);
        }
        if let Some(read) = edges.get(&edge) {
            let (from, to) = if along {
                (read.start, read.end)
            } else {
                (read.end, read.start)
            };
            vertices.push((edge, from, to));
        }
        uses.push((edge, along));
    }
    let Some(last) = vertices.last() else {
        return Err(ShapeFault::Empty("edges")).at(id);
    };
    let mut before = last.2;
    for (edge, from, to) in &vertices {
        if *from != before {
            return Err(ShapeFault::OpenLoop { edge: *edge }).at(id);
        }
        before = *to;
    }
    Ok(uses)
}

fn read_edge(geometry: &Geometry<'_>, id: u64) -> Result<ReadEdge, FaultAt> {
    let edge = geometry.file.one_of(id, &["EDGE_CURVE"])?;
    let (start, end) = (edge.reference(1)?, edge.reference(2)?);
    let ends = (vertex(geometry, start)?, vertex(geometry, end)?);
    let curve = geometry.curve(edge.reference(3)?)?;
    let span = EdgeSpan::new(&curve, ends, start == end, edge.boolean(4)?).at(id)?;
    Ok(ReadEdge { span, start, end })
}

fn vertex(geometry: &Geometry<'_>, id: u64) -> Result<Vector, FaultAt> {
    let vertex = geometry.file.one_of(id, &["VERTEX_POINT"])?;
    geometry.point(vertex.reference(1)?)
}

/// Checks that each edge is used twice, in opposite directions.
fn check_uses(faces: &[ReadFace]) -> Result<(), FaultAt> {
    let mut uses: HashMap<u64, (usize, usize)> = HashMap::new();
    for (edge, along) in faces.iter().flat_map(|face| &face.uses) {
        let (forth, back) = uses.entry(*edge).or_default();
        *(if *along { forth } else { back }) += 1;
    }
    let mut wrong: Vec<(u64, EdgeUse)> = Vec::new();
    for (edge, (forth, back)) in uses {
        match (forth, back) {
            (1, 1) => {}
            (1, 0) | (0, 1) => wrong.push((edge, EdgeUse::Once)),
            (2, 0) | (0, 2) => wrong.push((edge, EdgeUse::SameDirection)),
            (forth, back) => wrong.push((edge, EdgeUse::Often(forth + back))),
        }
    }
    match wrong.into_iter().min_by_key(|(edge, _)| *edge) {
        Some((edge, fault)) => Err(ShapeFault::EdgeUse(fault)).at(edge),
        None => Ok(()),
    }
}

fn check_face(
    geometry: &Geometry<'_>,
    face: &ReadFace,
    edges: &HashMap<u64, ReadEdge>,
    work: &mut u64,
) -> Result<CheckedFace, FaultAt> {
    let surface = geometry.surface(face.surface)?;
    for point in &face.points {
        let distance = surface.chart(vertex(geometry, *point)?).distance;
        if !matches!(distance.partial_cmp(&TOLERANCE), Some(std::cmp::Ordering::Less)) {
            return Err(ShapeFault::VertexOffCurve { distance }).at(*point);
        }
    }
    let mut counts: HashMap<u64, usize> = HashMap::new();
    for (edge, _) in &face.uses {
        *counts.entry(*edge).or_default() += 1;
    }
    let mut used = Vec::new();
    for (id, along) in &face.uses {
        let Some(edge) = edges.get(id) else {
            return Err(ShapeFault::Missing(*id)).at(face.id);
        };
        used.push(FaceEdge {
            id: *id,
            span: &edge.span,
            along: *along,
            is_seam: counts.get(id) == Some(&2),
        });
    }
    CheckedFace::new(surface, face.is_outward, &used, work).at(face.id)
}

/// Solids whose extents are read.
pub(crate) const SOLIDS: [&str; 2] = ["MANIFOLD_SOLID_BREP", "BREP_WITH_VOIDS"];
const AXES: [Vector; 3] = [Vector::X, Vector::Y, Vector::Z];
