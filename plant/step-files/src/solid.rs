//! Solids: their topology, checked, and bounds of their extents.

use std::collections::hash_map::Entry;
use std::collections::{HashMap, HashSet};

use crate::chart::FaceEdge;
use crate::edge::{Bounds, Curve, EdgeSpan, TOLERANCE};
use crate::face::CheckedFace;
use crate::fault::{EdgeUse, ShapeFault};
use crate::geometry::Geometry;
use crate::records::{AtEntity, EntityArguments, FaultAt};
use crate::surface::Surface;
use crate::vector::Vector;
use crate::work::{ReadingBudget, steps_of};

/// A solid whose shell is closed.
#[derive(Debug)]
pub(crate) struct CheckedSolid {
    id: u64,
    edges: Vec<SolidEdge>,
    faces: Vec<(u64, CheckedFace)>,
    /// Whether the sense of a face chooses between two parts of its surface.
    has_choice: bool,
}

/// An edge of a solid with the indices of its faces.
#[derive(Debug)]
struct SolidEdge {
    id: u64,
    span: EdgeSpan,
    faces: Vec<usize>,
}

/// An edge of the file.
struct ReadEdge {
    span: EdgeSpan,
    start: u64,
    end: u64,
}

/// The edges of a shell, and their curves, each of which is read once.
#[derive(Default)]
struct ReadEdges {
    all: HashMap<u64, ReadEdge>,
    curves: HashMap<u64, Curve>,
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
    pub(crate) fn read(
        geometry: &Geometry<'_>,
        id: u64,
        work: &mut ReadingBudget<'_>,
    ) -> Result<Self, FaultAt> {
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
        work: &mut ReadingBudget<'_>,
    ) -> Result<Self, FaultAt> {
        let shell = shell_of(geometry, shell)?;
        let ids = shell.references(1)?;
        if ids.is_empty() {
            return Err(ShapeFault::Empty("faces")).at(shell.id);
        }
        let mut edges = ReadEdges::default();
        let mut surfaces: HashMap<u64, Surface> = HashMap::new();
        let mut faces = Vec::new();
        let mut seen = HashSet::new();
        for id in ids {
            if !seen.insert(id) {
                return Err(ShapeFault::EdgeUse(EdgeUse::Often(2))).at(id);
            }
            faces.push(read_face(geometry, id, &mut edges, work)?);
        }
        let turned = turn_tori(geometry, &mut faces);
        check_uses(&faces)?;
        let edges = edges.all;
        let mut checked = Vec::new();
        for face in &faces {
            let surface = match surfaces.entry(face.surface) {
                Entry::Occupied(known) => known.get().clone(),
                Entry::Vacant(free) => free.insert(geometry.surface(face.surface, work)?).clone(),
            };
            let found = check_face((geometry, surface), face, &edges, work)?;
            checked.push((face.id, found));
        }
        let mut users: HashMap<u64, Vec<usize>> = HashMap::new();
        for (at, face) in faces.iter().enumerate() {
            for (edge, _) in &face.uses {
                users.entry(*edge).or_default().push(at);
            }
        }
        let edges = edges.into_iter().map(|(id, edge)| SolidEdge {
            id,
            span: edge.span,
            faces: users.remove(&id).unwrap_or_default(),
        });
        let mut edges: Vec<SolidEdge> = edges.collect();
        edges.sort_by_key(|edge| edge.id);
        let has_choice = checked.iter().any(|(_, face)| face.has_choice());
        let solid = Self {
            id: solid,
            edges,
            faces: checked,
            has_choice,
        };
        solid.check_folds(work)?;
        solid.check_turned(&turned)?;
        Ok(solid)
    }

    /// Checks that no two faces lie on each other at their edge: one of them has the wrong sense.
    fn check_folds(&self, work: &mut ReadingBudget<'_>) -> Result<(), FaultAt> {
        for edge in &self.edges {
            let middle = edge.span.points.get(edge.span.points.len() / 2);
            let middle = middle.copied().unwrap_or_default();
            let faces = edge.faces.iter().filter_map(|at| self.faces.get(*at));
            for (id, face) in faces.clone() {
                // As many again for the checks of tori and of the outermost edges.
                face.count_normals(8, work).at(*id)?;
            }
            let mut normals = faces.filter_map(|(_, face)| face.normal(middle));
            if let (Some(a), Some(b)) = (normals.next(), normals.next())
                && a.dot(b) < FOLDED
            {
                return Err(ShapeFault::Fold).at(edge.id);
            }
        }
        Ok(())
    }

    /// Checks that tori whose loops were turned go on smoothly in the faces beside all their edges.
    /// Then the sense of the face is right, and only the orientation of its bounds was wrong. At a
    /// sharp edge the whole face may be reversed instead, and would be the other part of the torus.
    fn check_turned(&self, turned: &[usize]) -> Result<(), FaultAt> {
        for edge in &self.edges {
            let [a, b] = edge.faces.as_slice() else {
                continue;
            };
            if a == b || !(turned.contains(a) || turned.contains(b)) {
                continue;
            }
            let (Some((_, a)), Some((_, b))) = (self.faces.get(*a), self.faces.get(*b)) else {
                continue;
            };
            let is_smooth = |at: &Vector| match (a.normal(*at), b.normal(*at)) {
                (Some(a), Some(b)) => a.dot(b) > SMOOTH,
                _ => false,
            };
            let points = &edge.span.points;
            let middle = points.get(points.len() / 2);
            let tried = [points.first(), middle, points.last()];
            if !tried.into_iter().flatten().all(is_smooth) {
                return Err(ShapeFault::EdgeUse(EdgeUse::SameDirection)).at(edge.id);
            }
        }
        Ok(())
    }

    /// Checks that the solid is inside of the faces at its outermost edge. A solid that is inside
    /// out may have the wrong parts of spheres and tori.
    fn check_outside(
        &self,
        direction: Vector,
        work: &mut ReadingBudget<'_>,
    ) -> Result<(), FaultAt> {
        let mut top = (f64::NEG_INFINITY, None);
        for edge in &self.edges {
            for point in &edge.span.points {
                let value = point.dot(direction);
                if value > top.0 {
                    top = (value, Some((edge, *point)));
                }
            }
        }
        let Some((_, point)) = top.1 else {
            return Ok(());
        };
        // All faces that meet at the point, of which one is steepest.
        let mut steepest = (0.0_f64, 0);
        let mut tried = 0;
        for edge in &self.edges {
            let is_here = |at: &Vector| (*at - point).length() <= TOLERANCE;
            if !edge.span.points.iter().any(is_here) {
                continue;
            }
            for (id, face) in edge.faces.iter().filter_map(|at| self.faces.get(*at)) {
                tried += 1;
                if tried > MOST_MEETING {
                    return Err(ShapeFault::TooLarge).at(*id);
                }
                face.count_normals(1, work).at(*id)?;
                let slope = face
                    .normal(point)
                    .map_or(0.0, |normal| normal.dot(direction));
                if slope.abs() > steepest.0.abs() {
                    steepest = (slope, *id);
                }
            }
        }
        if steepest.0 < -LEAST_SLOPE {
            return Err(ShapeFault::Inward).at(steepest.1);
        }
        Ok(())
    }

    /// Returns bounds of the largest value in a direction of length 1, and the entity that has the
    /// limit.
    ///
    /// # Errors
    /// The face at the extreme has its normal inwards.
    pub(crate) fn bounds(
        &self,
        direction: Vector,
        work: &mut ReadingBudget<'_>,
    ) -> Result<(Bounds, u64), FaultAt> {
        let (mut all, mut decisive) = (Bounds::NONE, self.id);
        let count = self.edges.len() + self.faces.len();
        work.spend(steps_of(count)).at(self.id)?;
        for edge in &self.edges {
            let bounds = edge.span.bounds(direction, work);
            work.spend(0).at(edge.id)?;
            if bounds.limit > all.limit {
                decisive = edge.id;
            }
            all = all.with(bounds);
        }
        let of_edges = all.reached;
        let mut inward = (f64::NEG_INFINITY, 0);
        let mut outward = of_edges;
        for (id, face) in &self.faces {
            let inner = face.inner(direction, of_edges, work);
            work.spend(0).at(*id)?;
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
        if self.has_choice && outward <= of_edges + TOLERANCE {
            let count = self
                .edges
                .iter()
                .map(|edge| edge.span.points.len())
                .sum::<usize>();
            work.spend(steps_of(count)).at(self.id)?;
            self.check_outside(direction, work)?;
        }
        Ok((all, decisive))
    }
}

/// Returns the shell with its faces; an oriented shell names another one.
fn shell_of<'f>(geometry: &Geometry<'f>, id: u64) -> Result<EntityArguments<'f>, FaultAt> {
    if let Some(oriented) = geometry.file.find(id, "ORIENTED_CLOSED_SHELL") {
        return geometry
            .file
            .one_of(oriented.reference(2)?, &["CLOSED_SHELL"]);
    }
    geometry.file.one_of(id, &["CLOSED_SHELL"])
}

fn read_face(
    geometry: &Geometry<'_>,
    id: u64,
    edges: &mut ReadEdges,
    work: &mut ReadingBudget<'_>,
) -> Result<ReadFace, FaultAt> {
    let face = geometry
        .file
        .one_of(id, &["ADVANCED_FACE", "FACE_SURFACE"])?;
    let mut uses = Vec::new();
    let mut points = Vec::new();
    for bound in face.references(1)? {
        let bound = geometry
            .file
            .one_of(bound, &["FACE_OUTER_BOUND", "FACE_BOUND"])?;
        let (ring, is_same) = (bound.reference(1)?, bound.boolean(2)?);
        if let Some(vertex) = geometry.file.find(ring, "VERTEX_LOOP") {
            points.push(vertex.reference(1)?);
            continue;
        }
        let ring = read_loop(geometry, ring, edges, work)?;
        uses.extend(
            ring.into_iter()
                .map(|(edge, along)| (edge, along == is_same)),
        );
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
    edges: &mut ReadEdges,
    work: &mut ReadingBudget<'_>,
) -> Result<Vec<(u64, bool)>, FaultAt> {
    let ring = geometry.file.one_of(id, &["EDGE_LOOP"])?;
    let mut uses = Vec::new();
    let mut vertices: Vec<(u64, u64, u64)> = Vec::new();
    for oriented in ring.references(1)? {
        let oriented = geometry.file.one_of(oriented, &["ORIENTED_EDGE"])?;
        let (edge, along) = (oriented.reference(3)?, oriented.boolean(4)?);
        if let Entry::Vacant(free) = edges.all.entry(edge) {
            free.insert(read_edge(geometry, edge, &mut edges.curves, work)?);
        }
        if let Some(read) = edges.all.get(&edge) {
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

fn read_edge(
    geometry: &Geometry<'_>,
    id: u64,
    curves: &mut HashMap<u64, Curve>,
    work: &mut ReadingBudget<'_>,
) -> Result<ReadEdge, FaultAt> {
    let edge = geometry.file.one_of(id, &["EDGE_CURVE"])?;
    let (start, end) = (edge.reference(1)?, edge.reference(2)?);
    let ends = (vertex(geometry, start)?, vertex(geometry, end)?);
    let of = edge.reference(3)?;
    let curve = match curves.entry(of) {
        Entry::Occupied(known) => known.into_mut(),
        Entry::Vacant(free) => free.insert(geometry.curve(of)?),
    };
    work.spend(curve.cost()).at(id)?;
    let span = EdgeSpan::new(curve, ends, start == end, edge.boolean(4)?).at(id)?;
    work.spend(span.cost()).at(id)?;
    Ok(ReadEdge { span, start, end })
}

fn vertex(geometry: &Geometry<'_>, id: u64) -> Result<Vector, FaultAt> {
    let vertex = geometry.file.one_of(id, &["VERTEX_POINT"])?;
    geometry.point(vertex.reference(1)?)
}

/// Turns the loops of a torus whose edges all run as in the faces beside it, and returns the
/// indices of these faces. Some writers give the bounds of tori the wrong orientation.
fn turn_tori(geometry: &Geometry<'_>, faces: &mut [ReadFace]) -> Vec<usize> {
    let mut uses: HashMap<(u64, bool), usize> = HashMap::new();
    for (edge, along) in faces.iter().flat_map(|face| &face.uses) {
        *uses.entry((*edge, *along)).or_default() += 1;
    }
    let mut turned = Vec::new();
    for (at, face) in faces.iter_mut().enumerate() {
        if !geometry.file.is(face.surface, "TOROIDAL_SURFACE") {
            continue;
        }
        let own: HashSet<(u64, bool)> = face.uses.iter().copied().collect();
        let is_seam = |(edge, along): &(u64, bool)| own.contains(&(*edge, !*along));
        let mut own_uses = face.uses.iter().filter(|used| !is_seam(used)).peekable();
        let is_turned =
            own_uses.peek().is_some() && own_uses.all(|used| uses.get(used) == Some(&2));
        if is_turned {
            turned.push(at);
            for (_, along) in &mut face.uses {
                *along = !*along;
            }
        }
    }
    turned
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
    (geometry, surface): (&Geometry<'_>, Surface),
    face: &ReadFace,
    edges: &HashMap<u64, ReadEdge>,
    work: &mut ReadingBudget<'_>,
) -> Result<CheckedFace, FaultAt> {
    let count = steps_of(face.points.len());
    work.spend(surface.cost().saturating_mul(count))
        .at(face.id)?;
    for point in &face.points {
        let distance = surface.chart(vertex(geometry, *point)?).distance;
        if !matches!(
            distance.partial_cmp(&TOLERANCE),
            Some(std::cmp::Ordering::Less)
        ) {
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
/// The cosine of the angle of two normals beyond which faces lie on each other.
const FOLDED: f64 = -0.995;
/// The cosine of the angle of two normals above which faces go on smoothly at their edge.
const SMOOTH: f64 = 0.999;
/// Maximum number of faces, counted by edge, that meet at a point.
const MOST_MEETING: usize = 256;
/// The least cosine of a normal and a direction that says on which side the solid is.
const LEAST_SLOPE: f64 = 0.05;
const AXES: [Vector; 3] = [Vector::X, Vector::Y, Vector::Z];
