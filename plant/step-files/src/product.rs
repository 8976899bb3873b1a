//! Products and assemblies: which shapes they have, where their parts are, and their extents.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use crate::edge::Bounds;
use crate::face::MOST_WORK;
use crate::fault::ShapeFault;
use crate::geometry::Geometry;
use crate::part21::{ExchangeFile, StepFault};
use crate::records::{AtEntity, FaultAt};
use crate::solid::{CheckedSolid, SOLIDS};
use crate::units::Units;
use crate::vector::{Placement, Vector};

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
        let file = ExchangeFile::read(bytes)?;
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
            work: 0,
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

/// The relations of products, shapes and parts.
struct ProductStructure<'f> {
    file: &'f ExchangeFile,
    /// The id and name of each product by its definition.
    definitions: BTreeMap<u64, (String, String)>,
    /// The representations of the shape of each definition.
    shapes: HashMap<u64, Vec<u64>>,
    /// Representations of one shape, in both directions.
    same: HashMap<u64, Vec<u64>>,
    /// The occurrences of each assembly, with their parts.
    parts: HashMap<u64, Vec<(u64, u64)>>,
    /// The relations that place each occurrence.
    places: HashMap<u64, Vec<u64>>,
    /// The first relation of each definition that is not read. It may have another part or shape.
    unread: HashMap<u64, FaultAt>,
    /// The first relation that is not read and names no definition.
    lost: Option<FaultAt>,
}

impl<'f> ProductStructure<'f> {
    fn read(file: &'f ExchangeFile) -> Self {
        let mut all = Self {
            file,
            definitions: BTreeMap::new(),
            shapes: HashMap::new(),
            same: HashMap::new(),
            parts: HashMap::new(),
            places: HashMap::new(),
            unread: HashMap::new(),
            lost: None,
        };
        for name in [
            "PRODUCT_DEFINITION",
            "PRODUCT_DEFINITION_WITH_ASSOCIATED_DOCUMENTS",
        ] {
            for id in file.all(name) {
                if let Ok(named) = all.product(id, name) {
                    all.definitions.insert(id, named);
                }
            }
        }
        all.relations();
        all.other_relations();
        all
    }

    /// Returns the id and name of the product of a definition.
    fn product(&self, id: u64, name: &'static str) -> Result<(String, String), FaultAt> {
        let formation = self.file.one_of(id, &[name])?.reference(2)?;
        let formations = [
            "PRODUCT_DEFINITION_FORMATION",
            "PRODUCT_DEFINITION_FORMATION_WITH_SPECIFIED_SOURCE",
        ];
        let formation = self.file.one_of(formation, &formations)?;
        let product = self.file.one_of(formation.reference(2)?, &["PRODUCT"])?;
        Ok((product.text(0).to_owned(), product.text(1).to_owned()))
    }

    fn relations(&mut self) {
        let file = self.file;
        for id in file.all("SHAPE_DEFINITION_REPRESENTATION") {
            let Some(relation) = file.find(id, "SHAPE_DEFINITION_REPRESENTATION") else {
                continue;
            };
            let pair = relation.reference(0).and_then(|shape| {
                let shape = file.one_of(shape, &["PRODUCT_DEFINITION_SHAPE"])?;
                Ok((shape.reference(2)?, relation.reference(1)?))
            });
            let property = relation.reference(0).ok();
            let property = property.and_then(|id| file.find(id, "PROPERTY_DEFINITION"));
            if let Ok((definition, shape)) = pair {
                self.shapes.entry(definition).or_default().push(shape);
            } else if let Some(Ok(of)) = property.map(|property| property.reference(2)) {
                // Properties of features, such as tolerances, are no shapes of products.
                if self.definitions.contains_key(&of) {
                    self.miss(id, Some(of));
                }
            } else {
                self.miss(id, None);
            }
        }
        for name in [
            "SHAPE_REPRESENTATION_RELATIONSHIP",
            "REPRESENTATION_RELATIONSHIP",
        ] {
            for id in file.all(name) {
                if file.is(id, "REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION") {
                    continue;
                }
                if let Ok((a, b)) = self.related(id) {
                    self.same.entry(a).or_default().push(b);
                    self.same.entry(b).or_default().push(a);
                } else {
                    self.miss(id, None);
                }
            }
        }
        for id in file.all("NEXT_ASSEMBLY_USAGE_OCCURRENCE") {
            let Some(usage) = file.find(id, "NEXT_ASSEMBLY_USAGE_OCCURRENCE") else {
                continue;
            };
            let usage = file
                .find(id, "PRODUCT_DEFINITION_RELATIONSHIP")
                .unwrap_or(usage);
            let is_known = |part: &u64| self.definitions.contains_key(part);
            let assembly = usage.reference(3).ok().filter(is_known);
            let part = usage.reference(4).ok().filter(is_known);
            match (assembly, part) {
                (Some(assembly), Some(part)) if file.is_simple(id) => {
                    self.parts.entry(assembly).or_default().push((id, part));
                }
                _ => self.miss(id, assembly),
            }
        }
        for id in file.all("CONTEXT_DEPENDENT_SHAPE_REPRESENTATION") {
            let Some(place) = file.find(id, "CONTEXT_DEPENDENT_SHAPE_REPRESENTATION") else {
                continue;
            };
            let pair = place.reference(1).and_then(|shape| {
                let shape = file.one_of(shape, &["PRODUCT_DEFINITION_SHAPE"])?;
                Ok((shape.reference(2)?, place.reference(0)?))
            });
            if let Ok((occurrence, relation)) = pair {
                self.places.entry(occurrence).or_default().push(relation);
            }
        }
    }

    /// Notes a relation that is not read, of a definition if it is known.
    fn miss(&mut self, id: u64, definition: Option<u64>) {
        let fault = ShapeFault::Unread(self.file.shown(id));
        let fault = FaultAt { entity: id, fault };
        match definition {
            Some(definition) => drop(self.unread.entry(definition).or_insert(fault)),
            None => drop(self.lost.get_or_insert(fault)),
        }
    }

    /// Notes parts and placements of kinds that are not read.
    fn other_relations(&mut self) {
        let file = self.file;
        for name in [
            "ASSEMBLY_COMPONENT_USAGE",
            "PROMISSORY_USAGE_OCCURRENCE",
            "QUANTIFIED_ASSEMBLY_COMPONENT_USAGE",
        ] {
            for id in file.all(name) {
                let is_other = |name: &&str| file.is(id, name);
                if [
                    "NEXT_ASSEMBLY_USAGE_OCCURRENCE",
                    "SPECIFIED_HIGHER_USAGE_OCCURRENCE",
                ]
                .iter()
                .any(is_other)
                {
                    continue;
                }
                let usage = file.find(id, "PRODUCT_DEFINITION_RELATIONSHIP");
                let assembly = usage.or_else(|| file.find(id, name));
                let assembly = assembly.and_then(|usage| usage.reference(3).ok());
                self.miss(id, assembly.filter(|of| self.definitions.contains_key(of)));
            }
        }
        let occurrences = self.parts.values().flatten();
        let placed: BTreeSet<u64> = occurrences
            .filter_map(|(occurrence, _)| self.places.get(occurrence))
            .flatten()
            .copied()
            .collect();
        let mut owners: BTreeMap<u64, Vec<u64>> = BTreeMap::new();
        for definition in self.definitions.keys() {
            for representation in self.representations(*definition) {
                owners.entry(representation).or_default().push(*definition);
            }
        }
        for id in file.all("REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION") {
            if placed.contains(&id) {
                continue;
            }
            let related = self.related(id).map(|(a, b)| [a, b]).unwrap_or_default();
            let related = related.iter().filter_map(|of| owners.get(of)).flatten();
            let related: BTreeSet<u64> = related.copied().collect();
            // A part does not lack what its assembly lacks.
            let is_part = |of: &u64| {
                let assemblies = related.iter().filter_map(|other| self.parts.get(other));
                assemblies.flatten().any(|(_, part)| part == of)
            };
            let lacking: Vec<u64> = related.iter().copied().filter(|of| !is_part(of)).collect();
            for definition in lacking {
                self.miss(id, Some(definition));
            }
        }
        for of_one in owners.values() {
            let [first, .., last] = of_one.as_slice() else {
                continue;
            };
            for definition in of_one {
                let other = if definition == first { last } else { first };
                let fault = FaultAt {
                    entity: *definition,
                    fault: ShapeFault::OtherProduct(*other),
                };
                self.unread.entry(*definition).or_insert(fault);
            }
        }
    }

    /// Returns both representations of a relation.
    fn related(&self, id: u64) -> Result<(u64, u64), FaultAt> {
        let relation = self.file.one_of(
            id,
            &[
                "REPRESENTATION_RELATIONSHIP",
                "SHAPE_REPRESENTATION_RELATIONSHIP",
                "REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION",
            ],
        )?;
        Ok((relation.reference(2)?, relation.reference(3)?))
    }

    /// Returns all representations of the shape of a definition.
    fn representations(&self, definition: u64) -> BTreeSet<u64> {
        let direct = self.shapes.get(&definition);
        let mut open: Vec<u64> = direct.cloned().unwrap_or_default();
        let mut all = BTreeSet::new();
        while let Some(id) = open.pop() {
            if all.insert(id) {
                open.extend(self.same.get(&id).into_iter().flatten());
            }
        }
        all
    }

    fn items(&self, representation: u64) -> Result<Vec<u64>, FaultAt> {
        self.file
            .one_of(representation, &REPRESENTATIONS)?
            .references(1)
    }

    fn geometry(&self, representation: u64) -> Result<Geometry<'f>, FaultAt> {
        let context = self
            .file
            .one_of(representation, &REPRESENTATIONS)?
            .reference(2)?;
        Ok(Geometry {
            file: self.file,
            units: Units::of(self.file, context)?,
        })
    }

    /// Returns the placement of an occurrence: from the part to the assembly.
    fn placement(
        &self,
        occurrence: u64,
        (assembly, part): (u64, u64),
    ) -> Result<Placement, FaultAt> {
        let places = self
            .places
            .get(&occurrence)
            .map(Vec::as_slice)
            .unwrap_or_default();
        let [relation] = places else {
            return Err(ShapeFault::Placements(places.len())).at(occurrence);
        };
        let (first, second) = self.related(*relation)?;
        let with = self.file.one_of(
            *relation,
            &["REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION"],
        )?;
        let transformation = with.reference(with.len().saturating_sub(1))?;
        let between = self
            .file
            .one_of(transformation, &["ITEM_DEFINED_TRANSFORMATION"])?;
        let (of_first, of_second) = (between.reference(2)?, between.reference(3)?);
        let (of_part, of_assembly) = (self.representations(part), self.representations(assembly));
        let is_forward = of_part.contains(&first) && of_assembly.contains(&second);
        let is_backward = of_part.contains(&second) && of_assembly.contains(&first);
        if is_forward == is_backward
            || !self.items(first)?.contains(&of_first)
            || !self.items(second)?.contains(&of_second)
        {
            return Err(ShapeFault::Unrelated).at(*relation);
        }
        let from = self.geometry(first)?.placement(of_first)?;
        let to = self.geometry(second)?.placement(of_second)?;
        Ok(if is_forward {
            to.after(&from.inverse())
        } else {
            from.after(&to.inverse())
        })
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
    work: u64,
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
        let parts = self.structure.parts.get(&assembly);
        let parts = parts.map(Vec::as_slice).unwrap_or_default();
        let occurrences = parts.iter().map(|(entity, part)| {
            let usage = self
                .structure
                .file
                .find(*entity, "NEXT_ASSEMBLY_USAGE_OCCURRENCE");
            let text = |at: usize| usage.map_or("", |usage| usage.text(at)).to_owned();
            let placement = self.structure.placement(*entity, (assembly, *part));
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

    /// Returns bounds of the largest value of a shape in a direction. `within` are the shapes that
    /// contain it.
    fn bounds(&mut self, shape: Shape, direction: Vector, within: &mut Vec<Shape>) -> Found {
        let bits = [direction.x, direction.y, direction.z].map(f64::to_bits);
        if let Some(known) = self.known.get(&(shape, bits)) {
            return known.clone();
        }
        let (Shape::Definition(id) | Shape::Representation(id)) = shape;
        self.work = self.work.saturating_add(100);
        if self.work > MOST_WORK || within.len() > DEEPEST {
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
            let placement = structure.placement(*occurrence, (id, *part))?;
            let shape = Shape::Definition(*part);
            let found = self.placed((shape, &placement), direction, within);
            let found = found.map_err(|fault| {
                let is_kept = matches!(
                    fault.fault,
                    ShapeFault::Cycle | ShapeFault::TooLarge | ShapeFault::OfPart(_)
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
        for item in structure.items(id)? {
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
/// Representations of shapes.
const REPRESENTATIONS: [&str; 4] = [
    "ADVANCED_BREP_SHAPE_REPRESENTATION",
    "SHAPE_REPRESENTATION",
    "MANIFOLD_SURFACE_SHAPE_REPRESENTATION",
    "FACETED_BREP_SHAPE_REPRESENTATION",
];
