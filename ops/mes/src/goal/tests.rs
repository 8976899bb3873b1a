use knowledge::{KnowledgeSource, SourceKind};
use serde::Deserialize;

use super::*;

/// A problem in the form of the file.
#[derive(Deserialize)]
struct Problem {
    name: String,
    given: BTreeSet<String>,
    wants: BTreeSet<String>,
    avoids: BTreeSet<String>,
    actions: Vec<(String, [BTreeSet<String>; 4])>,
    /// The length of the plan that the planner pyperplan finds (breadth first); null if there is
    /// none.
    length: Option<usize>,
}

impl Problem {
    fn goal(&self) -> GoalConditions {
        GoalConditions {
            iri: "urn:goal".into(),
            name: self.name.clone(),
            given: self.given.clone(),
            wants: self.wants.clone(),
            avoids: self.avoids.clone(),
            ..GoalConditions::default()
        }
    }

    fn actions(&self) -> Vec<GoalAction> {
        let action = |(name, [requires, forbids, adds, removes]): &(String, [_; 4])| GoalAction {
            iri: format!("urn:action:{name}"),
            name: name.clone(),
            capability: format!("urn:capability:{name}"),
            requires: BTreeSet::clone(requires),
            forbids: forbids.clone(),
            adds: adds.clone(),
            removes: removes.clone(),
            parameters: Vec::new(),
        };
        self.actions.iter().map(action).collect()
    }
}

/// Checks each step of a sequence by its conditions, without the search.
fn is_sound(goal: &GoalConditions, actions: &[GoalAction], sequence: &Sequence) {
    let mut holds = goal.given.clone();
    for step in &sequence.steps {
        let action = actions
            .iter()
            .find(|action| action.iri == step.action)
            .unwrap();
        assert!(action.requires.is_subset(&holds), "{}", step.name);
        assert!(action.forbids.is_disjoint(&holds), "{}", step.name);
        holds.retain(|fact| !action.removes.contains(fact));
        holds.extend(action.adds.iter().cloned());
    }
    assert!(goal.wants.is_subset(&holds) && goal.avoids.is_disjoint(&holds));
}

#[test]
fn twenty_problems_have_plans_as_long_as_those_of_another_planner() {
    let problems: Vec<Problem> = serde_json::from_str(include_str!("problems.json")).unwrap();
    assert!(problems.len() >= 20);
    assert!(problems.iter().any(|problem| problem.length >= Some(15)));
    assert!(
        problems
            .iter()
            .filter(|problem| problem.length.is_none())
            .count()
            >= 3
    );
    for problem in &problems {
        let (goal, actions) = (problem.goal(), problem.actions());
        let found = goal.search(&actions);
        let length = found.as_ref().map(|sequence| sequence.steps.len()).ok();
        assert_eq!(
            length,
            problem.length,
            "{}: {:?}",
            problem.name,
            found.as_ref().err()
        );
        if let Ok(sequence) = &found {
            is_sound(&goal, &actions, sequence);
        }
    }
}

#[test]
fn a_sequence_has_at_most_as_many_steps_as_a_process() {
    let chain = |length: usize| {
        let action = |number: usize| GoalAction {
            iri: format!("urn:action:{number}"),
            requires: [format!("fact {number}")].into(),
            adds: [format!("fact {}", number + 1)].into(),
            ..GoalAction::default()
        };
        let actions: Vec<GoalAction> = (0..length).map(action).collect();
        let goal = GoalConditions {
            given: ["fact 0".to_owned()].into(),
            wants: [format!("fact {length}")].into(),
            ..GoalConditions::default()
        };
        goal.search(&actions).map(|sequence| sequence.steps.len())
    };
    assert_eq!(chain(MOST_STEPS).unwrap(), MOST_STEPS);
    let refused = chain(MOST_STEPS + 1).unwrap_err();
    assert!(matches!(refused, GoalFault::TooLong(101)), "{refused}");
}

const TURTLE: &str = r#"@prefix ua: <urn:ua-bridge:plant#> . @prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> .
@prefix cask: <http://www.w3id.org/hsu-aut/cask#> . @prefix : <urn:f:> .
<urn:grasp> a ua:Action ; rdfs:label "grasp" ; ua:ofCapability <urn:c:grasp> ;
  ua:requires :at-tray ; ua:forbids :holding ; ua:adds :holding ; ua:removes :on-tray .
<urn:release> a ua:Action ; ua:ofCapability <urn:c:release> ; ua:requires :holding , :at-bin ; ua:adds :in-bin ; ua:removes :holding .
<urn:to-bin> a ua:Action ; rdfs:label "move to the bin" ; ua:ofCapability <urn:c:move> ; ua:adds :at-bin ; ua:removes :at-tray ;
  ua:hasParameter [ cask:hasVariableName "TargetPosition" ; ua:valueJson "[0.4,0,0.2,0,0,0]" ] .
<urn:goal> a ua:Goal ; rdfs:label "sort" ; ua:given :at-tray , :on-tray ; ua:wants :in-bin ; ua:avoids :holding ; ua:within 9 .
<urn:never> a ua:Goal ; ua:wants :painted .
<urn:empty> a ua:Goal ; ua:given :at-tray ."#;

#[test]
fn a_goal_of_the_graph_becomes_a_process_with_a_proof_of_each_step() {
    let knowledge = Knowledge::new().unwrap();
    let source = KnowledgeSource::new(SourceKind::File, "goals.ttl");
    knowledge.replace_turtle(&source, TURTLE, 1).unwrap();
    let actions = GoalAction::read(&knowledge).unwrap();
    let goal = GoalConditions::read(&knowledge, "urn:goal").unwrap();
    let sequence = goal.search(&actions).unwrap();
    is_sound(&goal, &actions, &sequence);
    let names: Vec<&str> = sequence
        .steps
        .iter()
        .map(|step| step.name.as_str())
        .collect();
    assert_eq!(names, ["grasp", "move to the bin", "urn:release"]);
    let condition = |fact: &str, holds, since| GoalCondition {
        fact: format!("urn:f:{fact}"),
        holds,
        since,
    };
    let because = [
        condition("at-tray", true, 0),
        condition("holding", false, 0),
    ];
    assert_eq!(sequence.steps[0].because, because);
    let because = [condition("at-bin", true, 2), condition("holding", true, 1)];
    assert_eq!(sequence.steps[2].because, because);
    let reached = [condition("in-bin", true, 3), condition("holding", false, 3)];
    assert_eq!(sequence.reached, reached);
    let process = goal.process(&sequence, &actions);
    assert_eq!((process.steps.len(), process.within.as_secs()), (3, 9));
    assert_eq!(process.steps[1].parameters[0].name, "TargetPosition");
    let need = &process.steps[2].needs[0];
    assert_eq!(
        (need.role, need.capability.as_deref()),
        (SkillRole::Alone(2), Some("urn:c:release"))
    );
    // Without the capability to release there is no sequence.
    let without: Vec<GoalAction> = actions
        .iter()
        .filter(|one| one.iri != "urn:release")
        .cloned()
        .collect();
    assert_eq!(
        goal.search(&without).unwrap_err().to_string(),
        "no available action adds urn:f:in-bin"
    );
    let never = GoalConditions::read(&knowledge, "urn:never").unwrap();
    assert_eq!(
        never.search(&actions).unwrap_err().to_string(),
        "no available action adds urn:f:painted"
    );
    let empty = GoalConditions::read(&knowledge, "urn:empty").unwrap_err();
    assert_eq!(empty.to_string(), "it has no ua:wants or ua:avoids");
    let nothing = GoalConditions::read(&knowledge, "urn:nothing").unwrap_err();
    assert!(matches!(nothing, GoalFault::Unknown), "{nothing}");
}
