//! The relations of the products of a file, of their shapes and of their parts.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use crate::fault::ShapeFault;
use crate::geometry::Geometry;
use crate::part21::ExchangeFile;
use crate::records::{AtEntity, FaultAt};
use crate::units::Units;
use crate::vector::Placement;
use crate::work::{ReadingBudget, steps_of};

/// The relations of products, shapes and parts.
pub(crate) struct ProductStructure<'f> {
    pub(crate) file: &'f ExchangeFile,
    /// The id and name of each product by its definition.
    pub(crate) definitions: BTreeMap<u64, (String, String)>,
    /// The representations of the shape of each definition.
    shapes: HashMap<u64, Vec<u64>>,
    /// Representations of one shape, in both directions.
    same: HashMap<u64, Vec<u64>>,
    /// All representations of the shape of each definition.
    representations: HashMap<u64, BTreeSet<u64>>,
    /// Relations of representations whose contexts differ, each with one of them.
    mixed: Vec<(u64, u64)>,
    /// The occurrences of each assembly, with their parts.
    pub(crate) parts: HashMap<u64, Vec<(u64, u64)>>,
    /// The relations that place each occurrence.
    places: HashMap<u64, Vec<u64>>,
    /// The first relation of each definition that is not read. It may have another part or shape.
    pub(crate) unread: HashMap<u64, FaultAt>,
    /// The first relation that is not read and names no definition.
    pub(crate) lost: Option<FaultAt>,
}

impl<'f> ProductStructure<'f> {
    pub(crate) fn read(file: &'f ExchangeFile) -> Self {
        let mut all = Self {
            file,
            definitions: BTreeMap::new(),
            shapes: HashMap::new(),
            same: HashMap::new(),
            representations: HashMap::new(),
            mixed: Vec::new(),
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
                let named = all.product(id, name).unwrap_or_else(|fault| {
                    all.unread.insert(id, fault);
                    Default::default()
                });
                all.definitions.insert(id, named);
            }
        }
        all.relations();
        all.complete_shapes();
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
                    // Their units may differ. Other kinds of representations are findings later.
                    if let (Ok(of_a), Ok(of_b)) = (self.context(a), self.context(b))
                        && of_a != of_b
                    {
                        self.mixed.push((id, a));
                    }
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
        for (relation, representation) in std::mem::take(&mut self.mixed) {
            for definition in owners.get(&representation).into_iter().flatten() {
                let fault = FaultAt {
                    entity: relation,
                    fault: ShapeFault::Contexts,
                };
                self.unread.entry(*definition).or_insert(fault);
            }
        }
        let pairs = self.parts.iter();
        let pairs = pairs.flat_map(|(of, parts)| parts.iter().map(|(_, part)| (*of, *part)));
        let pairs: HashSet<(u64, u64)> = pairs.collect();
        let mut steps = 0;
        for id in file.all("REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION") {
            if placed.contains(&id) {
                continue;
            }
            let related = self.related(id).map(|(a, b)| [a, b]).unwrap_or_default();
            let related = related.iter().filter_map(|of| owners.get(of)).flatten();
            let related: BTreeSet<u64> = related.copied().collect();
            steps += related.len() * related.len();
            if steps > MOST_RELATED {
                let fault = ShapeFault::TooLarge;
                self.lost.get_or_insert(FaultAt { entity: id, fault });
                return;
            }
            // A part does not lack what its assembly lacks.
            let is_part = |of: &u64| related.iter().any(|other| pairs.contains(&(*other, *of)));
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

    /// Finds all representations of the shape of each definition.
    fn complete_shapes(&mut self) {
        let mut steps = 0;
        for (definition, direct) in &self.shapes {
            let mut open = direct.clone();
            let mut all = BTreeSet::new();
            while let Some(id) = open.pop() {
                if all.insert(id) {
                    let same = self.same.get(&id).map(Vec::as_slice).unwrap_or_default();
                    steps += 1 + same.len();
                    open.extend(same);
                }
                if steps > MOST_RELATED {
                    let fault = ShapeFault::TooLarge;
                    let entity = *definition;
                    self.lost.get_or_insert(FaultAt { entity, fault });
                    return;
                }
            }
            self.representations.insert(*definition, all);
        }
    }

    /// Returns all representations of the shape of a definition.
    pub(crate) fn representations(&self, definition: u64) -> impl Iterator<Item = u64> + '_ {
        let all = self.representations.get(&definition);
        all.into_iter().flatten().copied()
    }

    /// Returns whether a representation is of the shape of a definition.
    fn has(&self, definition: u64, representation: u64) -> bool {
        let all = self.representations.get(&definition);
        all.is_some_and(|all| all.contains(&representation))
    }

    fn context(&self, representation: u64) -> Result<u64, FaultAt> {
        self.file
            .one_of(representation, &REPRESENTATIONS)?
            .reference(2)
    }

    pub(crate) fn items(&self, representation: u64) -> Result<Vec<u64>, FaultAt> {
        self.file
            .one_of(representation, &REPRESENTATIONS)?
            .references(1)
    }

    pub(crate) fn geometry(&self, representation: u64) -> Result<Geometry<'f>, FaultAt> {
        let context = self.context(representation)?;
        Ok(Geometry {
            file: self.file,
            units: Units::of(self.file, context)?,
        })
    }

    /// Returns the placement of an occurrence: from the part to the assembly. Counts the work.
    pub(crate) fn placement(
        &self,
        occurrence: u64,
        (assembly, part): (u64, u64),
        work: &mut ReadingBudget<'_>,
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
        let is_forward = self.has(part, first) && self.has(assembly, second);
        let is_backward = self.has(part, second) && self.has(assembly, first);
        let (items, others) = (self.items(first)?, self.items(second)?);
        let count = steps_of(items.len().saturating_add(others.len()));
        work.spend(count).at(*relation)?;
        if is_forward == is_backward || !items.contains(&of_first) || !others.contains(&of_second) {
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

/// Maximum number of relations that are followed to find the shapes of all definitions.
const MOST_RELATED: usize = 2_000_000;
/// Representations of shapes.
const REPRESENTATIONS: [&str; 4] = [
    "ADVANCED_BREP_SHAPE_REPRESENTATION",
    "SHAPE_REPRESENTATION",
    "MANIFOLD_SURFACE_SHAPE_REPRESENTATION",
    "FACETED_BREP_SHAPE_REPRESENTATION",
];
