//! LocateObject, the skill that finds objects in the graph.

use std::collections::BTreeMap;
use std::sync::Arc;

use async_trait::async_trait;
use knowledge::{Knowledge, QuestionAnswer};
use serde_json::Value as Json;
use skills::{Driver, DriverError, RunResults, SkillValue, Work};

/// Looks up the object of its parameter in the graph.
pub(crate) struct LocateObject {
    pub(crate) knowledge: Arc<Knowledge>,
}

#[async_trait]
impl Driver for LocateObject {
    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let id = work.parameters().text("ObjectId").unwrap_or_default();
        let answer = self.knowledge.ask("objects", &[]);
        let answer = answer.map_err(DriverError::device)?;
        located(&answer, id).map_err(DriverError::device)
    }
}

/// The reason why the graph does not locate an object.
#[derive(Debug, PartialEq, thiserror::Error)]
enum UnlocatedObject {
    #[error("the graph has no object `{id}`")]
    Missing { id: String },
    #[error("the graph has several objects `{id}`")]
    Several { id: String },
    #[error("`{column}` of the object `{id}` has other numbers")]
    Numbers { column: &'static str, id: String },
}

/// Returns the results for an object, which is identified by its `ua:objectId` or by its IRI.
fn located(answer: &QuestionAnswer, id: &str) -> Result<RunResults, UnlocatedObject> {
    let owned = || id.to_owned();
    let is_it = |row: &&BTreeMap<String, Json>| {
        [
            QuestionAnswer::text(row, "id"),
            QuestionAnswer::text(row, "object"),
        ]
        .contains(&id)
    };
    let mut rows = answer.rows.iter().filter(is_it);
    let row = rows
        .next()
        .ok_or_else(|| UnlocatedObject::Missing { id: owned() })?;
    if rows.next().is_some() {
        return Err(UnlocatedObject::Several { id: owned() });
    }
    let wrong = |column| UnlocatedObject::Numbers {
        column,
        id: owned(),
    };
    let numbers = |column: &'static str, count: usize| match row.get(column) {
        None | Some(Json::Null) => Ok(vec![0.0; count]),
        Some(Json::String(text)) => numbers_of(text, count).ok_or_else(|| wrong(column)),
        Some(Json::Number(number)) if count == 1 => Ok(number.as_f64().into_iter().collect()),
        Some(_) => Err(wrong(column)),
    };
    let mass = numbers("mass", 1)?.first().copied().unwrap_or_default();
    Ok(vec![
        ("Pose".to_owned(), SkillValue::from(numbers("pose", 6)?)),
        ("Box".to_owned(), SkillValue::from(numbers("box", 3)?)),
        (
            "Cylinder".to_owned(),
            SkillValue::from(numbers("cylinder", 2)?),
        ),
        ("Mass".to_owned(), SkillValue::from(mass)),
    ])
}

/// Reads exactly so many finite numbers, separated by spaces.
pub(crate) fn numbers_of(text: &str, count: usize) -> Option<Vec<f64>> {
    let numbers: Vec<f64> = text
        .split_whitespace()
        .map(|number| {
            number
                .parse()
                .ok()
                .filter(|number: &f64| number.is_finite())
        })
        .collect::<Option<_>>()?;
    (numbers.len() == count).then_some(numbers)
}

#[cfg(test)]
mod tests {
    use knowledge::{KnowledgeSource, SourceKind};

    use super::*;

    const OBJECTS: &str = r#"@prefix ua: <urn:ua-bridge:plant#> .
<urn:test:box> ua:objectId "box" ; ua:pose "0.4 0.2 0.1 0 0 1.5" ; ua:box "0.04 0.06 0.05" ; ua:mass 0.2 .
<urn:test:bolt> ua:objectId "bolt" ; ua:pose "0.3 0.3 0.1 0 0 0" ; ua:cylinder "0.01 0.04" .
<urn:test:nut1> ua:objectId "nut" ; ua:pose "0 0 0 0 0 0" .
<urn:test:nut2> ua:objectId "nut" ; ua:pose "1 0 0 0 0 0" .
<urn:test:odd> ua:objectId "odd" ; ua:pose "1 2 3" .
"#;

    #[test]
    fn an_object_is_found_by_its_id_or_iri_and_others_are_refused_with_the_reason() {
        let knowledge = Knowledge::new().unwrap();
        let source = KnowledgeSource::new(SourceKind::File, "objects.ttl");
        knowledge.replace_turtle(&source, OBJECTS, 1).unwrap();
        let answer = knowledge.ask("objects", &[]).unwrap();
        let find = |id: &str| located(&answer, id);
        let value = |results: &RunResults, name: &str| {
            let mut all = results.iter();
            all.find(|(known, _)| known == name).unwrap().1.as_f64s()
        };
        let found = find("box").unwrap();
        let pose = vec![0.4, 0.2, 0.1, 0.0, 0.0, 1.5];
        assert_eq!(value(&found, "Pose"), Some(pose));
        assert_eq!(value(&found, "Box"), Some(vec![0.04, 0.06, 0.05]));
        assert_eq!(found[3], ("Mass".to_owned(), SkillValue::from(0.2)));
        let bolt = find("urn:test:bolt").unwrap();
        assert_eq!(value(&bolt, "Cylinder"), Some(vec![0.01, 0.04]));
        assert_eq!(value(&bolt, "Box"), Some(vec![0.0; 3]));
        for (id, why) in [
            ("screw", "the graph has no object `screw`"),
            ("nut", "the graph has several objects `nut`"),
            ("odd", "`pose` of the object `odd` has other numbers"),
        ] {
            assert_eq!(find(id).unwrap_err().to_string(), why);
        }
    }
}
