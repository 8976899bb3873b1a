//! Products and assemblies: which shapes they have, where their parts are, and their extents.

use std::collections::HashMap;

use crate::edge::Bounds;
use crate::fault::ShapeFault;
use crate::part21::{ExchangeFile, StepFault};
use crate::records::{AtEntity, FaultAt};
use crate::solid::{CheckedSolid, SOLIDS};
use crate::structure::ProductStructure;
use crate::units::Units;
use crate::vector::{Placement, Vector};
use crate::work::{ReadingBudget, steps_of};

/// The products of a STEP file.
#[derive(Debug, Clone, PartialEq)]
pub struct StepProducts {
    /// The products in the order of the file.
    pub products: Vec<StepProduct>,
    /// Reasons why products have no extents, in the order of the products.
    pub findings: Vec<StepFinding>,
}

/// A product of a STEP file.
#[derive(Debug, Clone, PartialEq)]
pub struct StepProduct {
    /// The number of its PRODUCT_DEFINITION.
    pub entity: u64,
    /// The id that its maker gave, such as the number of a part.
    pub id: String,
    /// Its name.
    pub name: String,
    /// The box around its shape in its own axes; `None` if it is not proven.
    pub extents: Option<ProductExtents>,
    /// The parts of an assembly with their placements.
    pub occurrences: Vec<ProductOccurrence>,
}

/// A box around a shape, in metres. Each bound is wrong by 0.04 mm at most.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProductExtents {
    /// The least x, y and z.
    pub min: [f64; 3],
    /// The largest x, y and z.
    pub max: [f64; 3],
}

impl ProductExtents {
    /// Returns the lengths along x, y and z in metres.
    #[must_use]
    pub fn size(&self) -> [f64; 3] {
        pairwise(self.max, self.min, |max, min| max - min)
    }

    /// Returns the middle of the box in metres.
    #[must_use]
    pub fn centre(&self) -> [f64; 3] {
        pairwise(self.max, self.min, f64::midpoint)
    }
}

fn pairwise(a: [f64; 3], b: [f64; 3], of: impl Fn(f64, f64) -> f64) -> [f64; 3] {
    let ([ax, ay, az], [bx, by, bz]) = (a, b);
    [of(ax, bx), of(ay, by), of(az, bz)]
}

/// A part of an assembly.
#[derive(Debug, Clone, PartialEq)]
pub struct ProductOccurrence {
    /// The number of its NEXT_ASSEMBLY_USAGE_OCCURRENCE.
    pub entity: u64,
    /// Its id in the assembly.
    pub id: String,
    /// Its name in the assembly.
    pub name: String,
    /// The number of the PRODUCT_DEFINITION of the part.
    pub part: u64,
    /// Its placement in the assembly; `None` with a finding.
    pub pose: Option<OccurrencePose>,
}

/// The placement of a part in an assembly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OccurrencePose {
    /// The origin of the part, in metres.
    pub position: [f64; 3],
    /// The axes x, y and z of the part.
    pub axes: [[f64; 3]; 3],
}

/// Reason why a product has no extents.
#[derive(Debug, Clone, PartialEq)]
pub struct StepFinding {
    /// The number of the PRODUCT_DEFINITION.
    pub product: u64,
    /// The name of the product.
    pub name: String,
    /// The number of the record that is the reason, such as a face.
    pub entity: u64,
    /// The line of this record, from 1.
    pub line: Option<usize>,
    /// The reason.
    pub fault: ShapeFault,
}

impl std::fmt::Display for StepFinding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if let Some(line) = self.line {
            write!(f, "line {line}: ")?;
        }
        let Self {
            name,
            entity,
            fault,
            ..
        } = self;
        write!(f, "no extents of `{name}`: #{entity}: {fault}")
    }
}

impl StepProducts {
    /// Reads the products of a file. A product whose extents are not proven has a finding.
    ///
    /// # Errors
    /// The first reason why the file is not a STEP file of products.
    pub fn read(bytes: &[u8]) -> Result<Self, StepFault> {
        Self::read_until(bytes, &|| false)
    }

    /// Reads the products of a file, like [`Self::read`], until `is_over` returns true. Then the
    /// products that are left have findings.
    ///
    /// # Errors
    /// The first reason why the file is not a STEP file of products, or that its records cannot be
    /// read in time.
    pub fn read_until(bytes: &[u8], is_over: &dyn Fn() -> bool) -> Result<Self, StepFault> {
        let file = ExchangeFile::read(bytes, is_over)?;
        let is_known = |schema: &String| SCHEMAS.iter().any(|known| schema.starts_with(known));
        if !file.schemas.iter().any(is_known) {
            let found = file.schemas.join(", ").chars().take(200).collect();
            return Err(StepFault::Schema { found });
        }
        let structure = ProductStructure::read(&file);
        if structure.definitions.is_empty() {
            return Err(StepFault::NoProduct);
        }
        let mut reading = ShapeReading {
            structure: &structure,
            solids: HashMap::new(),
            known: HashMap::new(),
            placements: HashMap::new(),
            work: ReadingBudget::new(is_over),
        };
        let mut all = Self {
            products: Vec::new(),
            findings: Vec::new(),
        };
        for (entity, definition) in &structure.definitions {
            let extents = reading.extents(*entity);
            let occurrences = reading.occurrences(*entity);
            let mut faults: Vec<FaultAt> = Vec::new();
            let extents = match extents {
                Ok(extents) => Some(extents),
                Err(fault) => {
                    faults.push(fault);
                    None
                }
            };
            let (id, name) = definition.clone();
            for FaultAt { entity: at, fault } in faults {
                let line = file.records.get(&at).map(|record| record.line);
                all.findings.push(StepFinding {
                    product: *entity,
                    name: name.clone(),
                    entity: at,
                    line,
                    fault,
                });
            }
            all.products.push(StepProduct {
                entity: *entity,
                id,
                name,
                extents,
                occurrences,
            });
        }
        Ok(all)
    }
}

/// Something that has a shape.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Shape {
    Definition(u64),
    Representation(u64),
}

/// Bounds with the entity of the limit.
type Found = Result<(Bounds, u64), FaultAt>;

struct ShapeReading<'f> {
    structure: &'f ProductStructure<'f>,
    /// Solids that were read, by their number and the units of length and angle.
    solids: HashMap<(u64, [u64; 2]), Result<CheckedSolid, FaultAt>>,
    /// Bounds by the shape and the direction.
    known: HashMap<(Shape, [u64; 3]), Found>,
    placements: HashMap<u64, Result<Placement, FaultAt>>,
    work: ReadingBudget<'f>,
}

impl ShapeReading<'_> {
    fn extents(&mut self, definition: u64) -> Result<ProductExtents, FaultAt> {
        let mut least = [0.0; 3];
        let mut largest = [0.0; 3];
        let axes = [('x', Vector::X), ('y', Vector::Y), ('z', Vector::Z)];
        for ((axis, direction), (min, max)) in
            axes.into_iter().zip(least.iter_mut().zip(&mut largest))
        {
            for (direction, value, sign) in [(direction, max, 1e-3), (-direction, min, -1e-3)] {
                let shape = Shape::Definition(definition);
                let (bounds, entity) = self.bounds(shape, direction, &mut Vec::new())?;
                let gap = bounds.limit - bounds.reached;
                if !(gap.is_finite() && gap <= MOST_GAP) {
                    return Err(ShapeFault::Gap { axis, gap }).at(entity);
                }
                *value = f64::midpoint(bounds.reached, bounds.limit) * sign;
            }
        }
        Ok(ProductExtents {
            min: least,
            max: largest,
        })
    }

    fn occurrences(&mut self, assembly: u64) -> Vec<ProductOccurrence> {
        let structure = self.structure;
        let parts = structure.parts.get(&assembly);
        let parts = parts.map(Vec::as_slice).unwrap_or_default();
        let occurrences = parts.iter().map(|(entity, part)| {
            let usage = structure
                .file
                .find(*entity, "NEXT_ASSEMBLY_USAGE_OCCURRENCE");
            let text = |at: usize| usage.map_or("", |usage| usage.text(at)).to_owned();
            let placement = self.placement(*entity, (assembly, *part));
            ProductOccurrence {
                entity: *entity,
                id: text(0),
                name: text(1),
                part: *part,
                pose: placement.ok().map(|placement| pose(&placement)),
            }
        });
        occurrences.collect()
    }

    /// Returns the placement of an occurrence, which is read once.
    fn placement(&mut self, occurrence: u64, between: (u64, u64)) -> Result<Placement, FaultAt> {
        let (structure, work) = (self.structure, &mut self.work);
        let known = self.placements.entry(occurrence);
        known
            .or_insert_with(|| structure.placement(occurrence, between, work))
            .clone()
    }

    /// Returns bounds of the largest value of a shape in a direction. `within` are the shapes that
    /// contain it.
    fn bounds(&mut self, shape: Shape, direction: Vector, within: &mut Vec<Shape>) -> Found {
        let bits = [direction.x, direction.y, direction.z].map(f64::to_bits);
        if let Some(known) = self.known.get(&(shape, bits)) {
            return known.clone();
        }
        let (Shape::Definition(id) | Shape::Representation(id)) = shape;
        self.work.spend(OF_SHAPE).at(id)?;
        if within.len() > DEEPEST {
            return Err(ShapeFault::TooLarge).at(id);
        }
        if within.contains(&shape) {
            return Err(ShapeFault::Cycle).at(id);
        }
        within.push(shape);
        let found = match shape {
            Shape::Definition(id) => self.of_definition(id, direction, within),
            Shape::Representation(id) => self.of_items(id, direction, within),
        };
        within.pop();
        self.known.insert((shape, bits), found.clone());
        found
    }

    fn of_definition(&mut self, id: u64, direction: Vector, within: &mut Vec<Shape>) -> Found {
        let structure = self.structure;
        let mut all = (Bounds::NONE, id);
        for representation in structure.representations(id) {
            let shape = Shape::Representation(representation);
            all = with(all, self.bounds(shape, direction, within)?);
        }
        for (occurrence, part) in structure.parts.get(&id).into_iter().flatten() {
            let placement = self.placement(*occurrence, (id, *part))?;
            let shape = Shape::Definition(*part);
            let found = self.placed((shape, &placement), direction, within);
            let found = found.map_err(|fault| {
                let is_kept = matches!(
                    fault.fault,
                    ShapeFault::Cycle
                        | ShapeFault::TooLarge
                        | ShapeFault::Late
                        | ShapeFault::OfPart(_)
                );
                if is_kept {
                    fault
                } else {
                    FaultAt {
                        entity: *occurrence,
                        fault: ShapeFault::OfPart(*part),
                    }
                }
            })?;
            all = with(all, found);
        }
        if let Some(fault) = structure.unread.get(&id).or(structure.lost.as_ref()) {
            return Err(fault.clone());
        }
        if all.0.reached.is_finite() {
            Ok(all)
        } else {
            Err(ShapeFault::NoShape).at(id)
        }
    }

    /// Returns bounds of a shape that is placed in another one.
    fn placed(
        &mut self,
        (shape, placement): (Shape, &Placement),
        direction: Vector,
        within: &mut Vec<Shape>,
    ) -> Found {
        let local = placement.local_direction(direction);
        // Rounding may have changed the length a little.
        let local = local.unit().unwrap_or(local);
        let (bounds, entity) = self.bounds(shape, local, within)?;
        let offset = placement.origin.dot(direction);
        let bounds = Bounds {
            reached: bounds.reached + offset,
            limit: bounds.limit + offset,
        };
        Ok((bounds, entity))
    }

    fn of_items(&mut self, id: u64, direction: Vector, within: &mut Vec<Shape>) -> Found {
        let structure = self.structure;
        let geometry = structure.geometry(id)?;
        let mut all = (Bounds::NONE, id);
        let items = structure.items(id)?;
        self.work.spend(steps_of(items.len())).at(id)?;
        for item in items {
            if structure.file.is(item, "AXIS2_PLACEMENT_3D") {
                continue;
            }
            if let Some(mapped) = structure.file.find(item, "MAPPED_ITEM") {
                let source = mapped.reference(1)?;
                let source = structure.file.one_of(source, &["REPRESENTATION_MAP"])?;
                let (origin, inner) = (source.reference(0)?, source.reference(1)?);
                let from = structure.geometry(inner)?.placement(origin)?;
                let to = geometry.placement(mapped.reference(2)?)?;
                let placement = to.after(&from.inverse());
                let shape = Shape::Representation(inner);
                all = with(all, self.placed((shape, &placement), direction, within)?);
                continue;
            }
            structure.file.one_of(item, &SOLIDS)?;
            let Units { length, angle } = geometry.units;
            let key = (item, [length, angle.unwrap_or_default()].map(f64::to_bits));
            let work = &mut self.work;
            let solid = self
                .solids
                .entry(key)
                .or_insert_with(|| CheckedSolid::read(&geometry, item, work));
            let found = solid
                .as_ref()
                .map_err(Clone::clone)?
                .bounds(direction, work)?;
            all = with(all, found);
        }
        Ok(all)
    }
}

fn with(all: (Bounds, u64), more: (Bounds, u64)) -> (Bounds, u64) {
    let entity = if more.0.limit > all.0.limit {
        more.1
    } else {
        all.1
    };
    (all.0.with(more.0), entity)
}

fn pose(placement: &Placement) -> OccurrencePose {
    let numbers = |vector: Vector, by: f64| [vector.x * by, vector.y * by, vector.z * by];
    OccurrencePose {
        position: numbers(placement.origin, 1e-3),
        axes: [placement.x, placement.y, placement.z].map(|axis| numbers(axis, 1.0)),
    }
}

/// The work of a shape beside that of its items.
const OF_SHAPE: u64 = 100;
/// The largest distance of the bounds of an extreme in millimetres.
const MOST_GAP: f64 = 0.04;
/// Maximum depth of assemblies and mapped shapes.
const DEEPEST: usize = 64;
/// The beginnings of the schemas of AP203, AP214 and AP242.
const SCHEMAS: [&str; 6] = [
    "CONFIG_CONTROL_DESIGN",
    "CONFIG_CONTROL_3D_DESIGN",
    "AP203",
    "AUTOMOTIVE_DESIGN",
    "AP214",
    "AP242",
];
