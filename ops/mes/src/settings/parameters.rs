//! The parameters of a step: values, results of earlier steps, and queries.

use skills::yaml::{DocumentKind, DocumentNode, YamlFindingCode};

use super::{Reading, json};
use crate::process::{GivenParameter, ParameterQuery, ProcessStep, ResultOf};
use crate::read_process::readable;

impl Reading<'_, '_> {
    /// Reads the parameters of a step, which follows these steps.
    pub(super) fn parameters(
        &mut self,
        node: &DocumentNode,
        earlier: &[ProcessStep],
    ) -> Option<Vec<GivenParameter>> {
        let DocumentKind::Map(pairs) = &node.kind else {
            self.reader
                .wrong(node, "a map from names of parameters to values");
            return None;
        };
        let mut given = Vec::new();
        for (key, value) in pairs {
            if let Some(name) = self.reader.text(key, "the name of a parameter") {
                given.extend(self.given(name, value, earlier));
            }
        }
        Some(given)
    }

    /// Reads a parameter: its value, a map of `value` and `unit`, a query, or the result of a step.
    fn given(
        &mut self,
        name: &str,
        node: &DocumentNode,
        earlier: &[ProcessStep],
    ) -> Option<GivenParameter> {
        let mut given = GivenParameter {
            name: name.to_owned(),
            value: serde_json::Value::Null,
            unit: None,
            result: None,
            query: None,
        };
        if !matches!(&node.kind, DocumentKind::Map(_)) {
            given.value = json(node);
            return Some(given);
        }
        let keys = ["value", "unit", "result", "of", "query", "query_name"];
        let [value, unit, result, of, query, query_name] = self.reader.map(node, keys)?;
        if let Some(unit) = unit {
            given.unit = Some(self.reader.text(unit, "a unit")?.to_owned());
        }
        if query.is_some() || query_name.is_some() {
            if let Some(other) = value.or(result).or(of) {
                let why = "a query is the value";
                return self
                    .reader
                    .refuse(other, YamlFindingCode::WrongValue, why.to_owned());
            }
            return self.queried(given, (query, query_name), node);
        }
        if result.is_none() && of.is_none() {
            given.value = json(self.reader.needed(value, "value", node.place)?);
            return Some(given);
        }
        if let Some(other) = value.or(unit) {
            let why = "a result has the value and the unit of its skill";
            return self
                .reader
                .refuse(other, YamlFindingCode::WrongValue, why.to_owned());
        }
        let of = self.reader.needed(of, "of", node.place)?;
        let step = self.earlier(of, earlier)?;
        let result = match result {
            Some(result) => self.reader.text(result, "the name of a result")?,
            None => name,
        };
        given.result = Some(ResultOf {
            step,
            name: result.to_owned(),
        });
        Some(given)
    }

    /// Reads the query of a parameter.
    fn queried(
        &mut self,
        mut given: GivenParameter,
        (query, name): (Option<&DocumentNode>, Option<&DocumentNode>),
        node: &DocumentNode,
    ) -> Option<GivenParameter> {
        let query = self.reader.needed(query, "query", node.place)?;
        let sparql = self.reader.text(query, "a SELECT with one variable")?;
        let name = match name {
            Some(name) => self.reader.text(name, "the name of a query")?.to_owned(),
            None => given.name.clone(),
        };
        given.query = Some(ParameterQuery {
            name,
            sparql: sparql.to_owned(),
        });
        let read = readable(given);
        read.map_err(|why| {
            self.reader
                .refuse::<()>(query, YamlFindingCode::WrongValue, why.to_string());
        })
        .ok()
    }
}
