//! The skills of all components, from the values and calls of the space.

use std::collections::{BTreeMap, BTreeSet};

use bridge_node::{CallDescription, CallField, CallRole};
use mappings::TopicId;
use messages::ArrayRank;
use serde_json::{Map, Value, json};

use crate::board::{CellBoard, TopicEntry};
use crate::value;

/// Returns the tiles of all skills.
pub(crate) fn all(board: &CellBoard) -> Vec<Value> {
    let calls: Calls<'_> = board
        .calls
        .iter()
        .map(|(topic, (call, _))| {
            let (space, namespace, _) = topic.triple();
            ((space, namespace, call.name.as_str()), (*topic, &**call))
        })
        .collect();
    let states = board.topics.iter().filter_map(|(topic, entry)| {
        let name = entry.description.name.strip_suffix(STATE)?;
        let (component, skill) = name.rsplit_once('.')?;
        Some((*topic, entry, component, skill))
    });
    let mut tiles: Vec<(String, Value)> = states
        .map(|(topic, entry, component, skill)| {
            let name = format!("{component}.{skill}");
            let tile = tile((board, &calls), (topic, entry), (component, skill));
            (name, tile)
        })
        .collect();
    tiles.sort_by(|(a, _), (b, _)| a.cmp(b));
    tiles.into_iter().map(|(_, tile)| tile).take(MOST).collect()
}

/// Returns the calls that are neither methods of skills nor parts of actions, by name.
pub(crate) fn calls(board: &CellBoard) -> Vec<Value> {
    let states = board.topics.values();
    let skills: BTreeSet<&str> = states
        .filter_map(|entry| entry.description.name.strip_suffix(STATE))
        .collect();
    let is_of_skill = |name: &str| {
        let method = name.rsplit_once('.');
        method.is_some_and(|(skill, method)| METHODS.contains(&method) && skills.contains(skill))
    };
    let others = board
        .calls
        .iter()
        .filter(|(_, (call, _))| matches!(call.role, CallRole::Call) && !is_of_skill(&call.name));
    let mut shown: Vec<(&str, TopicId, Value)> = others
        .map(|(topic, (call, is_own))| {
            let results = call.response.iter().take(MOST_FIELDS);
            let results: Vec<&str> = results.map(|field| field.name.as_str()).collect();
            let one = json!({
                "topic": topic.to_string(), "name": call.name, "about": call.about, "fields": form(call),
                "results": results, "is_own": is_own,
            });
            (call.name.as_str(), *topic, one)
        })
        .collect();
    shown.sort_by_key(|(name, topic, _)| (*name, *topic));
    shown
        .into_iter()
        .map(|(.., call)| call)
        .take(MOST)
        .collect()
}

/// The calls by their space, namespace and name.
type Calls<'b> = BTreeMap<(u16, u16, &'b str), (TopicId, &'b CallDescription)>;

fn tile(
    (board, all): (&CellBoard, &Calls<'_>),
    (topic, entry): (TopicId, &TopicEntry),
    (component, skill): (&str, &str),
) -> Value {
    let state = shown(entry);
    let result = result_of(topic).and_then(|topic| board.topics.get(&topic));
    let result = result.filter(|result| result.count > 0).map(shown);
    let is_silent = entry.is_silent || entry.received.is_none();
    let get = |name: &str| state.get(name).cloned().unwrap_or_default();
    let mut calls = Map::new();
    for method in METHODS {
        let name = format!("{component}.{skill}.{method}");
        let (space, namespace, _) = topic.triple();
        if let Some((of, call)) = all.get(&(space, namespace, name.as_str())) {
            let form = json!({ "topic": of.to_string(), "fields": form(call) });
            calls.insert(method.to_owned(), form);
        }
    }
    let about = entry.description.about.split_once("nsu=");
    let skill_type = about.and_then(|(before, _)| before.split_whitespace().next_back());
    json!({
        "component": component,
        "skill": skill,
        "topic": topic.to_string(),
        "type": skill_type,
        "state": if is_silent { json!("no data") } else { get("state") },
        "run": get("run"),
        "progress": get("progress"),
        "step": get("step"),
        "transition": get("last_transition"),
        "result": result.map(outcome),
        "calls": calls,
    })
}

fn shown(entry: &TopicEntry) -> Map<String, Value> {
    let fields = value::fields(&entry.block, &entry.description.fields);
    fields.unwrap_or_default().into_iter().collect()
}

/// Returns the outcome of the last run.
fn outcome(result: Map<String, Value>) -> Value {
    let list = |name: &str| {
        let found = result.get(name).and_then(Value::as_array);
        found.cloned().unwrap_or_default()
    };
    let results: Map<String, Value> = list("names")
        .iter()
        .filter_map(Value::as_str)
        .map(str::to_owned)
        .zip(list("values"))
        .collect();
    json!({
        "run": result.get("run"),
        "succeeded": result.get("succeeded"),
        "message": result.get("message"),
        "results": results,
    })
}

/// Returns the fields of a request for a form.
pub(crate) fn form(call: &CallDescription) -> Vec<Value> {
    call.request.iter().take(MOST_FIELDS).map(field).collect()
}

/// Returns a field for a form.
pub(crate) fn field(field: &CallField) -> Value {
    let fixed = match field.rank {
        ArrayRank::Scalar => None,
        ArrayRank::Array { fixed } => fixed,
    };
    json!({
        "name": field.name,
        "type": field.builtin.name(),
        "array": !matches!(field.rank, ArrayRank::Scalar),
        "length": fixed,
        "optional": field.optional,
    })
}

/// Returns the topic of the result from the topic of the state.
fn result_of(state: TopicId) -> Option<TopicId> {
    let (space, namespace, id) = state.triple();
    TopicId::new(space, namespace, id.checked_add(RESULT_ID - STATE_ID)?)
}

/// The suffix of the name of a state, after `<component>.<skill>`.
const STATE: &str = ".State";
const METHODS: [&str; 5] = ["Start", "Halt", "Suspend", "Resume", "Reset"];
/// Offset of the state among the identifiers of a skill.
const STATE_ID: u16 = 1;
/// Offset of the result.
const RESULT_ID: u16 = 4;
const MOST: usize = 500;
const MOST_FIELDS: usize = 64;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use uadp::BuiltinType;

    use super::*;
    use crate::announced::AnnouncedValue;
    use crate::board::BoardSample;
    use crate::board::tests::{at, topic};

    fn text(block: &mut Vec<u8>, text: &str) {
        block.push(12);
        block.extend(i32::try_from(text.len()).unwrap().to_le_bytes());
        block.extend(text.as_bytes());
    }

    fn with_state() -> CellBoard {
        let mut board = CellBoard::default();
        let state = topic("ua_0_7_101");
        board.describe(
            state,
            AnnouncedValue {
                name: "gripper.Grasp.State".to_owned(),
                type_name: "ua_msgs/SkillState".to_owned(),
                about: "GraspSkillType nsu=urn:x".to_owned(),
                fields: ["state", "step"].map(str::to_owned).to_vec(),
                ..AnnouncedValue::default()
            },
        );
        let mut block = vec![2, 0];
        text(&mut block, "Running");
        text(&mut block, "Closing");
        let sample = BoardSample {
            topic: state,
            block: &block.into(),
            source: None,
            status: 0,
        };
        board.take(sample, at(0));
        let start = CallDescription {
            name: "gripper.Grasp.Start".to_owned(),
            about: String::new(),
            role: CallRole::Call,
            request: vec![CallField::scalar("Force", BuiltinType::Double).optional()],
            response: Vec::new(),
        };
        let switch = CallDescription {
            name: "Conveyor.Switch".to_owned(),
            ..start.clone()
        };
        board.offer(topic("ua_0_7_105"), &Arc::new(start), false);
        board.offer(topic("ua_1_2_61"), &Arc::new(switch), false);
        board
    }

    #[test]
    fn a_skill_has_its_state_and_the_form_of_its_start() {
        let board = with_state();
        let tiles = all(&board);
        assert_eq!(tiles.len(), 1);
        let tile = &tiles[0];
        assert_eq!(tile["state"], "Running");
        assert_eq!(tile["type"], "GraspSkillType");
        assert_eq!(tile["calls"]["Start"]["topic"], "ua_0_7_105");
        assert_eq!(tile["calls"]["Start"]["fields"][0]["optional"], true);
        assert!(tile["calls"].get("Halt").is_none());
    }

    #[test]
    fn calls_beside_the_methods_of_skills_are_listed_with_their_forms() {
        let calls = calls(&with_state());
        assert_eq!(calls.len(), 1);
        assert_eq!(calls[0]["name"], "Conveyor.Switch");
        assert_eq!(calls[0]["fields"][0]["name"], "Force");
    }

    #[test]
    fn a_skill_whose_component_is_lost_has_no_state() {
        let mut board = with_state();
        board.set_silent(topic("ua_0_7_101"), true);
        assert_eq!(all(&board)[0]["state"], "no data");
    }
}
