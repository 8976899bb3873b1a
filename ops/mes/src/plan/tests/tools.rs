//! The tools that steps attach and detach.

use super::*;
use crate::process::{BadEnd, Loop, StepCondition, Test};

fn named(tool: &str) -> Vec<GivenParameter> {
    vec![GivenParameter {
        value: tool.into(),
        result: None,
        ..result_of(0, "", "ToolAppUri")
    }]
}

/// A changer and two grippers.
fn offers() -> Vec<Offer> {
    let skill = |name: &str, of: &str| {
        offer(
            "changer",
            name,
            &[of],
            &[&format!("urn:{}", name.to_lowercase())],
        )
    };
    let changer = vec![
        skill("Change", "ChangeToolSkillType"),
        skill("Detach", "DetachToolSkillType"),
    ];
    [changer, gripper("finger"), gripper("vacuum")].concat()
}

/// Facts by which a robot moves the changer.
struct Moving(&'static str);

impl Facts for Moving {
    fn takes(&self, offer: &Offer, step: (usize, &ProcessStep)) -> Result<(), ParameterFault> {
        KNOWN.takes(offer, step)
    }

    fn gives(&self, offer: &Offer, result: &str) -> Result<(), ParameterFault> {
        KNOWN.gives(offer, result)
    }

    fn connects(&self, from: (&str, &str), to: (&str, &str)) -> Result<(), ParameterFault> {
        KNOWN.connects(from, to)
    }

    fn moves(&self, offer: &Offer, changer: &str) -> bool {
        offer.component_name == self.0 && changer == "urn:example:changer"
    }
}

#[test]
fn the_robot_of_the_changer_moves_while_it_carries_a_tool() {
    let mut process = sequence(&[MOVE, "urn:change", MOVE, "urn:detach", MOVE]);
    process.steps[1].parameters = named("urn:example:vacuum");
    let offers = [offers(), robot("a-robot"), robot("robot")].concat();
    let chosen = |process: &Process, facts: &dyn Facts| {
        let found = super::super::plan(process, &offers, situation(&[]), facts);
        let moves = chosen(&found, 5).into_iter().step_by(2);
        moves.map(str::to_owned).collect::<Vec<_>>()
    };
    let first = "a-robot#Lin";
    assert_eq!(chosen(&process, &KNOWN), [first; 3]);
    assert_eq!(
        chosen(&process, &Moving("robot")),
        [first, "robot#Lin", first]
    );
    let found = super::super::plan(&process, &offers, situation(&[]), &Moving("robot"));
    assert_eq!(
        why(&found, SkillRole::Alone(2), "a-robot#Lin"),
        "it would fit, but robot.Lin carries a tool"
    );
    // A tool that may not be attached does not count.
    process.steps[1].when = if_failed(0);
    assert_eq!(chosen(&process, &Moving("robot")), [first; 3]);
}

/// Facts by which b-robot moves the changer, and shows that it carries a tool.
struct Carrying;

impl Facts for Carrying {
    fn takes(&self, offer: &Offer, step: (usize, &ProcessStep)) -> Result<(), ParameterFault> {
        KNOWN.takes(offer, step)
    }

    fn gives(&self, offer: &Offer, result: &str) -> Result<(), ParameterFault> {
        KNOWN.gives(offer, result)
    }

    fn connects(&self, from: (&str, &str), to: (&str, &str)) -> Result<(), ParameterFault> {
        KNOWN.connects(from, to)
    }

    fn attachment(&self, offer: &Offer) -> Attachment {
        match offer.component_name.as_str() {
            "b-robot" => Attachment::CarriesTool,
            _ => Attachment::None,
        }
    }

    fn moves(&self, offer: &Offer, changer: &str) -> bool {
        Moving("b-robot").moves(offer, changer)
    }
}

#[test]
fn a_robot_whose_tool_a_step_detached_carries_none() {
    let process = sequence(&[MOVE, "urn:detach", MOVE]);
    let offers = [offers(), robot("a-robot"), robot("b-robot")].concat();
    let mut tools = AttachedTools::default();
    let vacuum = Some("urn:example:vacuum".to_owned());
    tools.observe(&ShownTools {
        attached: BTreeMap::from([("urn:example:changer".to_owned(), vacuum)]),
        ..ShownTools::default()
    });
    let now = Situation {
        tools: Some(&tools),
        ..situation(&[])
    };
    let found = super::super::plan(&process, &offers, now, &Carrying);
    let moves: Vec<&str> = chosen(&found, 3).into_iter().step_by(2).collect();
    assert_eq!(moves, ["b-robot#Lin", "a-robot#Lin"]);
}

#[test]
fn a_robot_of_which_it_is_not_known_whether_a_tool_is_attached_is_not_preferred() {
    let process = sequence(&[MOVE, MOVE]);
    let offers = [offers(), robot("a-robot"), robot("robot")].concat();
    let by = || ToolStep {
        number: 0,
        name: "attach".to_owned(),
    };
    let vacuum = || Some("urn:example:vacuum".to_owned());
    let first = |tools: &AttachedTools| {
        let now = Situation {
            tools: Some(tools),
            ..situation(&[])
        };
        let found = super::super::plan(&process, &offers, now, &Moving("robot"));
        chosen(&found, 2)[1].to_owned()
    };
    let mut tools = AttachedTools::default();
    tools.attach("urn:example:changer", vacuum(), by());
    assert_eq!(first(&tools), "robot#Lin");
    tools.lose("urn:example:changer", vacuum(), by());
    assert_eq!(first(&tools), "a-robot#Lin");
}

/// A condition that is decided in the run.
fn if_failed(step: usize) -> Vec<Vec<StepCondition>> {
    vec![vec![StepCondition {
        step,
        test: Test::Ended(BadEnd::Failed),
        is_negated: true,
    }]]
}

#[test]
fn a_detached_tool_does_no_later_step() {
    let mut process = sequence(&["urn:change", GRASP, "urn:detach", GRASP]);
    process.steps[0].parameters = named("urn:example:vacuum");
    let found = plan(&process, &offers(), &[]);
    let expected = [
        "changer#Change",
        "vacuum#Grasp",
        "changer#Detach",
        "finger#Grasp",
    ];
    assert_eq!(chosen(&found, 4), expected);
    assert_eq!(
        why(&found, SkillRole::Alone(3), "vacuum#Grasp"),
        "the step `step 2` detaches this tool"
    );
    process.steps[3].by = By::AttachedTool;
    let none = plan(&process, &offers(), &[]);
    assert!(!none.is_complete());
    let expected = "finger.Grasp: the step `step 2` detaches the tool, and no step after it";
    assert!(none.missing().contains(expected), "{}", none.missing());
}

#[test]
fn a_step_that_may_be_skipped_leaves_both_tools_possible() {
    let mut process = sequence(&["urn:change", "urn:change", GRASP]);
    process.steps[0].parameters = named("urn:example:vacuum");
    process.steps[1].parameters = named("urn:example:finger");
    let certain = plan(&process, &offers(), &[]);
    assert_eq!(chosen(&certain, 3)[2], "finger#Grasp");
    process.steps[1].when = if_failed(0);
    process.steps[2].by = By::AttachedTool;
    for only in ["finger", "vacuum"] {
        let mut offers = offers();
        offers.retain(|offer| ["changer", only].contains(&&*offer.component_name));
        let found = plan(&process, &offers, &[]);
        assert!(found.is_complete(), "{}", found.missing());
    }
    // The step is passed.
    let situation = Situation {
        passed: &[1],
        ..Situation::default()
    };
    let found = super::super::plan(&process, &offers(), situation, &KNOWN);
    assert_eq!(
        found.chosen(SkillRole::Alone(2)),
        Some("urn:example:vacuum#Grasp")
    );
}

/// Plans a process while the changer has a tool.
fn plan_with(process: &Process, attached: &str) -> Plan {
    let mut tools = AttachedTools::default();
    let attached = Some(attached.to_owned());
    tools.observe(&ShownTools {
        attached: [("urn:example:changer".to_owned(), attached)].into(),
        tools: ["urn:example:finger", "urn:example:vacuum"]
            .map(str::to_owned)
            .into(),
    });
    let situation = Situation {
        tools: Some(&tools),
        ..Situation::default()
    };
    super::super::plan(process, &offers(), situation, &KNOWN)
}

#[test]
fn a_tool_that_a_step_may_not_attach_is_not_the_only_choice() {
    let mut process = sequence(&["urn:change", GRASP]);
    process.steps[0].parameters = named("urn:example:vacuum");
    process.steps[0].when = if_failed(0);
    let found = plan_with(&process, "urn:example:finger");
    assert_eq!(chosen(&found, 2)[1], "finger#Grasp");
    // The step attaches it in any case.
    process.steps[0].when = Vec::new();
    let found = plan_with(&process, "urn:example:finger");
    assert_eq!(chosen(&found, 2)[1], "vacuum#Grasp");
    let process = sequence(&[GRASP]);
    for (attached, expected) in [
        ("urn:example:finger", "finger#Grasp"),
        ("urn:example:vacuum", "vacuum#Grasp"),
        ("", "none"),
    ] {
        assert_eq!(chosen(&plan_with(&process, attached), 1), [expected]);
    }
    let found = plan_with(&process, "urn:example:finger");
    assert_eq!(
        why(&found, SkillRole::Alone(0), "vacuum#Grasp"),
        "no tool changer shows this tool, and no step before it attaches it"
    );
}

#[test]
fn a_choice_is_right_for_as_many_cases_as_possible() {
    let mut process = sequence(&["urn:change", "urn:change", GRASP]);
    process.steps[0].parameters = named("urn:example:vacuum");
    process.steps[1].parameters = named("urn:example:finger");
    process.steps[1].when = if_failed(0);
    process.steps[0].when = if_failed(0);
    let found = plan_with(&process, "urn:example:vacuum");
    assert_eq!(chosen(&found, 3)[2], "vacuum#Grasp");
    assert_eq!(
        why(&found, SkillRole::Alone(2), "finger#Grasp"),
        "it would fit only while another tool is attached"
    );
}

#[test]
fn a_tool_from_before_the_run_does_no_step_after_it_is_detached() {
    let mut process = sequence(&["urn:detach", GRASP]);
    let found = plan_with(&process, "urn:example:finger");
    assert!(!found.is_complete());
    assert_eq!(
        why(&found, SkillRole::Alone(1), "finger#Grasp"),
        "the step `step 0` detaches this tool"
    );
    process.steps.swap_remove(0);
    process.steps[0].needs[0].role = SkillRole::Alone(0);
    let found = plan_with(&process, "urn:example:finger");
    assert_eq!(chosen(&found, 1), ["finger#Grasp"]);
}

#[test]
fn a_tool_that_another_branch_detaches_at_any_time_is_refused() {
    let mut process = sequence(&["urn:change", "urn:detach", GRASP]);
    process.steps[0].parameters = named("urn:example:vacuum");
    process.steps[2].after = Some(vec![0]);
    process.steps[2].by = By::AttachedTool;
    let found = plan_with(&process, "urn:example:finger");
    assert_eq!(
        why(&found, SkillRole::Alone(2), "vacuum#Grasp"),
        "the step `step 1` detaches this tool at any time; order the two steps with `after`"
    );
    // The branch may not be taken.
    process.steps[1].when = if_failed(0);
    let found = plan_with(&process, "urn:example:finger");
    assert_eq!(chosen(&found, 3)[2], "vacuum#Grasp");
}

#[test]
fn a_tool_that_a_result_names_is_not_the_tool_before_it() {
    let mut process = sequence(&["urn:change", "urn:change", GRASP]);
    process.steps[0].parameters = named("urn:example:vacuum");
    process.steps[1].parameters = vec![result_of(0, "Change", "ToolAppUri")];
    process.steps[2].by = By::AttachedTool;
    let mut offers = offers();
    offers.retain(|offer| offer.component_name != "vacuum");
    let found = plan(&process, &offers, &[]);
    assert_eq!(chosen(&found, 3)[2], "finger#Grasp");
}

#[test]
fn the_tool_of_another_branch_is_not_the_attached_tool() {
    let mut process = sequence(&["urn:change", GRASP, GRASP]);
    process.steps[0].parameters = named("urn:example:vacuum");
    process.steps[1].after = Some(vec![]);
    process.steps[1].by = By::AttachedTool;
    process.steps[2].after = Some(vec![0]);
    let found = plan(&process, &offers(), &[]);
    let expected = "(finger.Grasp: no step before it attaches a tool";
    assert!(found.missing().contains(expected), "{}", found.missing());
    process.steps[1].by = By::Any;
    let found = plan(&process, &offers(), &[]);
    assert_eq!(
        chosen(&found, 3),
        ["changer#Change", "finger#Grasp", "vacuum#Grasp"]
    );
}

#[test]
fn the_tools_of_the_run_come_before_those_of_the_steps_that_are_left() {
    let mut process = sequence(&[GRASP, "urn:change"]);
    process.steps[1].parameters = named("urn:example:finger");
    process.loops = vec![Loop {
        steps: [0, 1].into(),
        again: Vec::new(),
        rounds: 2,
    }];
    let mut tools = AttachedTools::default();
    let by = ToolStep {
        number: 1,
        name: "step 1".to_owned(),
    };
    tools.attach(
        "urn:example:changer",
        Some("urn:example:vacuum".to_owned()),
        by,
    );
    tools.repeat(&[0, 1].into());
    let situation = Situation {
        tools: Some(&tools),
        ..Situation::default()
    };
    let found = super::super::plan(&process, &offers(), situation, &KNOWN);
    assert_eq!(chosen(&found, 2), ["vacuum#Grasp", "changer#Change"]);
}
