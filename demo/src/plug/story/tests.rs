use super::super::fact::{ExecutedSkill, RunPlan};
use super::*;

/// Returns a story in this act.
fn at(act: Act) -> PlugStory {
    let mut story = PlugStory::new();
    while story.act() != act {
        story.advance();
    }
    story
}

fn sees(story: &mut PlugStory, facts: impl IntoIterator<Item = (i64, Fact)>) {
    for (at_ns, fact) in facts {
        story.observe(at_ns, &fact);
    }
}

fn state(ros: Ros, state: &str, run: u32) -> Fact {
    Fact::Node(NodeEvent::State {
        ros,
        namespace: 7,
        state: state.to_owned(),
        run,
    })
}

fn ran(steps: &[&str]) -> RunPlan {
    let ran = steps.iter().map(|step| ExecutedSkill {
        step: (*step).to_owned(),
        component: PlugComponent::Gripper.uri().to_owned(),
        outcome: "running".to_owned(),
        ..ExecutedSkill::default()
    });
    RunPlan {
        outcome: "running".to_owned(),
        ran: ran.collect(),
        ..RunPlan::default()
    }
}

fn run(outcome: &str, plans: Vec<RunPlan>) -> MesRun {
    MesRun {
        outcome: outcome.to_owned(),
        plans,
        ..MesRun::default()
    }
}

#[test]
fn a_component_is_plugged_in_when_it_is_known_everywhere() {
    let mut story = at(Act::Robot);
    for level in VisibilityLevel::ALL {
        let lacks = story.missing().unwrap();
        assert!(
            lacks.contains(&format!("robot: not {}", level.label())),
            "{lacks:?}"
        );
        story.observe(1, &Fact::Reached(PlugComponent::Robot, level));
        // Facts about another component do not count.
        story.observe(1, &Fact::Reached(PlugComponent::Vacuum, level));
    }
    assert_eq!(story.missing(), Ok(Vec::new()));
    assert_eq!(story.advance(), ActStart::Plug(PlugComponent::Gripper));
    assert!(!story.missing().unwrap().is_empty());
}

#[test]
fn the_earliest_moment_of_a_kind_counts_in_whatever_order_it_is_told() {
    let mut story = PlugStory::new();
    for at_ns in [30, 20, 40] {
        story.observe(
            at_ns,
            &Fact::Reached(PlugComponent::Robot, VisibilityLevel::Registered),
        );
    }
    assert_eq!(
        story.reached[&(PlugComponent::Robot, VisibilityLevel::Registered)],
        20
    );
}

#[test]
fn a_grasp_from_ros_needs_the_answer_the_states_in_order_and_the_result() {
    let ros = Ros::Ros2;
    let mut story = at(Act::Gripper);
    sees(&mut story, [(1, state(ros, "Ready", 0))]);
    story.advance();
    let answered = NodeEvent::Answered {
        ros,
        success: true,
        message: String::new(),
    };
    let result = NodeEvent::Result {
        ros,
        namespace: 7,
        run: 1,
        succeeded: true,
        message: String::new(),
    };
    let facts = [
        (2, Fact::Node(NodeEvent::Asks { ros })),
        (3, Fact::Node(answered)),
        (4, state(ros, "Running", 1)),
        (5, state(ros, "Running", 1)),
        (6, Fact::Node(result)),
        (7, state(ros, "Ready", 1)),
    ];
    for (at_ns, fact) in facts {
        assert!(!story.missing().unwrap().is_empty(), "before {at_ns}");
        story.observe(at_ns, &fact);
    }
    assert_eq!(story.missing(), Ok(Vec::new()));
    let states: Vec<_> = story.grasps[&ros]
        .states
        .iter()
        .map(|(at, _)| *at)
        .collect();
    assert_eq!(states, [1, 4, 7]);
}

#[test]
fn the_result_of_an_earlier_run_is_not_that_of_this_grasp() {
    let ros = Ros::Ros1;
    let mut story = at(Act::GraspFromRos1);
    let result = |run| {
        Fact::Node(NodeEvent::Result {
            ros,
            namespace: 7,
            run,
            succeeded: run == 2,
            message: "old".to_owned(),
        })
    };
    sees(
        &mut story,
        [
            (1, state(ros, "Ready", 1)),
            (2, Fact::Node(NodeEvent::Asks { ros })),
            (3, result(1)),
        ],
    );
    assert_eq!(story.grasps[&ros].result, None);
    story.observe(4, &result(2));
    assert_eq!(story.grasps[&ros].result, Some((4, Ok(()))));
}

#[test]
fn a_refused_start_ends_the_story_with_the_reason() {
    let ros = Ros::Ros2;
    let mut story = at(Act::GraspFromRos2);
    let refused = NodeEvent::Answered {
        ros,
        success: false,
        message: "BadInvalidState: Halted".to_owned(),
    };
    story.observe(1, &Fact::Node(refused));
    let why = story.missing().unwrap_err();
    assert!(why.contains("BadInvalidState: Halted"), "{why}");
}

#[test]
fn the_gripper_is_killed_when_it_holds_the_part_and_not_before() {
    let mut story = at(Act::SecondRun);
    let early = run(
        "running",
        vec![ran(&["MovePickApproachBefore", "MovePick", "Grasp"])],
    );
    sees(&mut story, [(1, Fact::Run(1, early))]);
    assert_eq!(story.missing().unwrap().len(), 1);
    let holding = run("running", vec![ran(&["Grasp", "MovePickApproachAfter"])]);
    sees(&mut story, [(2, Fact::Run(1, holding))]);
    assert_eq!(story.missing(), Ok(Vec::new()));
    assert_eq!(story.advance(), ActStart::Kill(PlugComponent::Gripper));
}

#[test]
fn a_second_run_that_is_over_too_early_is_a_failure() {
    let mut story = at(Act::SecondRun);
    sees(
        &mut story,
        [(1, Fact::Run(1, run("done", vec![ran(&["MovePlace"])])))],
    );
    assert!(story.missing().is_err());
}

#[test]
fn who_died_has_to_be_missing_everywhere_and_the_robot_away() {
    let mut story = at(Act::SecondRun);
    let left = |level| Fact::Left(PlugComponent::Gripper, level);
    // No component is lost before the signal.
    sees(&mut story, [(1, left(VisibilityLevel::Registered))]);
    assert!(story.left.is_empty());
    story.advance();
    sees(&mut story, [(2, Fact::Killed(PlugComponent::Gripper))]);
    sees(&mut story, LOST_FROM.map(|level| (5, left(level))));
    let mut plan = ran(&["MovePickApproachAfter"]);
    "failed".clone_into(&mut plan.outcome);
    plan.reason = Some("parallel-gripper is lost".to_owned());
    assert_eq!(story.missing().unwrap().len(), 1);
    plan.retreated = Some(false);
    sees(
        &mut story,
        [(6, Fact::Run(1, run("running", vec![plan.clone()])))],
    );
    assert!(story.missing().is_err());
    plan.retreated = Some(true);
    sees(&mut story, [(7, Fact::Run(1, run("running", vec![plan])))]);
    assert_eq!(story.missing(), Ok(Vec::new()));
    assert_eq!(
        story.left[&(PlugComponent::Gripper, VisibilityLevel::InGraph)],
        5
    );
}

#[test]
fn the_second_run_has_to_end_by_another_plan() {
    let ends = |plans| {
        let mut story = at(Act::Vacuum);
        sees(
            &mut story,
            VisibilityLevel::ALL.map(|level| (1, Fact::Reached(PlugComponent::Vacuum, level))),
        );
        let plans = vec![ran(&["MovePlace"]); plans];
        let ended = Fact::CallEnded {
            run: 1,
            succeeded: true,
            why: String::new(),
        };
        sees(
            &mut story,
            [(2, Fact::Run(1, run("done", plans))), (3, ended)],
        );
        story.missing()
    };
    assert!(ends(1).is_err());
    assert_eq!(ends(2), Ok(Vec::new()));
}

#[test]
fn the_question_has_to_list_skills_and_services() {
    let asked = |skills, services, incomplete: &[&str]| {
        let mut story = at(Act::Question);
        let incomplete = incomplete.iter().map(|one| (*one).to_owned()).collect();
        let asked = CanRunAnswer {
            skills,
            services,
            incomplete,
        };
        sees(&mut story, [(1, Fact::Asked(asked))]);
        story.missing()
    };
    assert_eq!(asked(6, 1, &[]), Ok(Vec::new()));
    assert!(asked(6, 0, &[]).is_err());
    assert!(asked(5, 1, &[]).is_err());
    assert!(asked(6, 1, &["Dosing"]).is_err());
}
