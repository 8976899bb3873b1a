//! Typed access to the parameters of records.

use crate::fault::ShapeFault;
use crate::part21::{EntityPart, ExchangeFile, Parameter};

/// A fault with the number of its record.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FaultAt {
    pub(crate) entity: u64,
    pub(crate) fault: ShapeFault,
}

/// Gives a fault the number of its record.
pub(crate) trait AtEntity<T> {
    /// # Errors
    /// The fault with the number.
    fn at(self, entity: u64) -> Result<T, FaultAt>;
}

impl<T, E: Into<ShapeFault>> AtEntity<T> for Result<T, E> {
    fn at(self, entity: u64) -> Result<T, FaultAt> {
        self.map_err(|fault| FaultAt {
            entity,
            fault: fault.into(),
        })
    }
}

/// The parameters of an entity.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EntityArguments<'f> {
    pub(crate) id: u64,
    pub(crate) name: &'static str,
    all: &'f [Parameter],
}

impl ExchangeFile {
    /// Returns the entities of a record, for messages.
    pub(crate) fn shown(&self, id: u64) -> String {
        let Some(record) = self.records.get(&id) else {
            return "missing".to_owned();
        };
        let names = record
            .parts
            .iter()
            .map(|part| part.name.chars().take(60).collect());
        let mut names: Vec<String> = names.take(8).collect();
        if names.len() > 1 {
            // All complex instances have these, which say little.
            names.retain(|name| !COMMON.contains(&name.as_str()));
        }
        names.join(" ")
    }

    fn part(&self, id: u64, name: &str) -> Option<&EntityPart> {
        let record = self.records.get(&id)?;
        record.parts.iter().find(|part| part.name == name)
    }

    /// Returns whether a record has an entity.
    pub(crate) fn is(&self, id: u64, name: &str) -> bool {
        self.part(id, name).is_some()
    }

    /// Returns whether a record has a single entity.
    pub(crate) fn is_simple(&self, id: u64) -> bool {
        let record = self.records.get(&id);
        record.is_some_and(|record| record.parts.len() == 1)
    }

    /// Returns the parameters of an entity of a record, if the record has the entity.
    pub(crate) fn find(&self, id: u64, name: &'static str) -> Option<EntityArguments<'_>> {
        let all = &self.part(id, name)?.parameters;
        Some(EntityArguments { id, name, all })
    }

    /// Returns the parameters of the first of some entities that a record has.
    pub(crate) fn one_of(
        &self,
        id: u64,
        names: &[&'static str],
    ) -> Result<EntityArguments<'_>, FaultAt> {
        if !self.records.contains_key(&id) {
            return Err(ShapeFault::Missing(id)).at(id);
        }
        let found = names.iter().find_map(|name| self.find(id, name));
        found.ok_or_else(|| FaultAt {
            entity: id,
            fault: ShapeFault::Kind {
                found: self.shown(id),
                wanted: names.first().copied().unwrap_or_default(),
            },
        })
    }

    /// Returns the numbers of all records with an entity, in rising order.
    pub(crate) fn all(&self, name: &'static str) -> Vec<u64> {
        let ids = self.records.iter();
        let ids = ids.filter(|(_, record)| record.parts.iter().any(|part| part.name == name));
        let mut ids: Vec<u64> = ids.map(|(id, _)| *id).collect();
        ids.sort_unstable();
        ids
    }
}

impl<'f> EntityArguments<'f> {
    pub(crate) fn len(&self) -> usize {
        self.all.len()
    }

    fn wrong(&self, at: usize, wanted: &'static str) -> FaultAt {
        FaultAt {
            entity: self.id,
            fault: ShapeFault::Parameter {
                entity: self.name,
                number: at + 1,
                wanted,
            },
        }
    }

    pub(crate) fn is_omitted(&self, at: usize) -> bool {
        matches!(self.all.get(at), Some(Parameter::Omitted))
    }

    pub(crate) fn reference(&self, at: usize) -> Result<u64, FaultAt> {
        match self.all.get(at) {
            Some(Parameter::Reference(id)) => Ok(*id),
            _ => Err(self.wrong(at, "a reference")),
        }
    }

    /// Returns a text; an omitted one is empty.
    pub(crate) fn text(&self, at: usize) -> &'f str {
        match self.all.get(at) {
            Some(Parameter::Text(text)) => text,
            _ => "",
        }
    }

    pub(crate) fn number(&self, at: usize) -> Result<f64, FaultAt> {
        let number = self.all.get(at).and_then(number);
        number.ok_or_else(|| self.wrong(at, "a number"))
    }

    pub(crate) fn integer(&self, at: usize) -> Result<i64, FaultAt> {
        match self.all.get(at) {
            Some(Parameter::Integer(number)) => Ok(*number),
            _ => Err(self.wrong(at, "a whole number")),
        }
    }

    pub(crate) fn boolean(&self, at: usize) -> Result<bool, FaultAt> {
        match self.all.get(at) {
            Some(Parameter::Enumeration(name)) if name == "T" => Ok(true),
            Some(Parameter::Enumeration(name)) if name == "F" => Ok(false),
            _ => Err(self.wrong(at, ".T. or .F.")),
        }
    }

    pub(crate) fn enumeration(&self, at: usize) -> Option<&'f str> {
        match self.all.get(at) {
            Some(Parameter::Enumeration(name)) => Some(name),
            _ => None,
        }
    }

    fn list<T>(
        &self,
        at: usize,
        wanted: &'static str,
        read: impl Fn(&Parameter) -> Option<T>,
    ) -> Result<Vec<T>, FaultAt> {
        let list = match self.all.get(at) {
            Some(Parameter::List(list)) => list.iter().map(read).collect(),
            _ => None,
        };
        list.ok_or_else(|| self.wrong(at, wanted))
    }

    pub(crate) fn references(&self, at: usize) -> Result<Vec<u64>, FaultAt> {
        self.list(at, "a list of references", reference)
    }

    pub(crate) fn numbers(&self, at: usize) -> Result<Vec<f64>, FaultAt> {
        self.list(at, "a list of numbers", number)
    }

    pub(crate) fn integers(&self, at: usize) -> Result<Vec<i64>, FaultAt> {
        self.list(at, "a list of whole numbers", |item| {
            let Parameter::Integer(number) = item else {
                return None;
            };
            Some(*number)
        })
    }

    pub(crate) fn reference_rows(&self, at: usize) -> Result<Vec<Vec<u64>>, FaultAt> {
        self.list(at, "rows of references", |row| rows(row, reference))
    }

    pub(crate) fn number_rows(&self, at: usize) -> Result<Vec<Vec<f64>>, FaultAt> {
        self.list(at, "rows of numbers", |row| rows(row, number))
    }
}

fn rows<T>(row: &Parameter, read: impl Fn(&Parameter) -> Option<T>) -> Option<Vec<T>> {
    let Parameter::List(row) = row else {
        return None;
    };
    row.iter().map(read).collect()
}

fn reference(item: &Parameter) -> Option<u64> {
    let Parameter::Reference(id) = item else {
        return None;
    };
    Some(*id)
}

/// Returns a number, also within the name of its measure.
fn number(item: &Parameter) -> Option<f64> {
    match item {
        Parameter::Real(number) => Some(*number),
        // Whole numbers of coordinates are small; others are no coordinates.
        Parameter::Integer(number) => i32::try_from(*number).ok().map(f64::from),
        Parameter::Typed(_, parameters) => match parameters.as_slice() {
            [Parameter::Real(number)] => Some(*number),
            _ => None,
        },
        Parameter::Omitted
        | Parameter::Text(_)
        | Parameter::Enumeration(_)
        | Parameter::Reference(_)
        | Parameter::List(_) => None,
    }
}

/// Entities that say little of an instance.
const COMMON: [&str; 5] = [
    "GEOMETRIC_REPRESENTATION_ITEM",
    "REPRESENTATION_ITEM",
    "CURVE",
    "SURFACE",
    "TOPOLOGICAL_REPRESENTATION_ITEM",
];
