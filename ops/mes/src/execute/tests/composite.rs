//! The composite that moves an object.

use super::*;

#[tokio::test]
async fn a_process_is_planned_and_run_to_its_end() {
    let (run, fakes, told) = executed(plant(gripper("gripper")), &process()).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    assert_eq!(
        *fakes.journal.lock().unwrap(),
        [
            "robot.Ptp 1",
            "robot.Lin 1",
            "gripper.Grasp",
            "robot.Lin 1",
            "robot.Ptp 1",
            "robot.Lin 1",
            "gripper.Release",
            "robot.Lin 1",
            "closed"
        ]
    );
    assert_eq!((told.first(), told.last()), (Some(&"Init"), Some(&"Idle")));
    let [plan] = run.plans.as_slice() else {
        panic!("{run:?}")
    };
    let of: Vec<_> = plan.ran.iter().map(|ran| ran.of.as_str()).collect();
    assert_eq!(
        of,
        [
            "pick", "pick", "pick", "pick", "place", "place", "place", "place"
        ]
    );
    assert!(
        plan.ran
            .iter()
            .all(|ran| ran.outcome == How::Done && ran.ended_ms >= Some(ran.started_ms))
    );
}

#[tokio::test]
async fn a_gripper_lost_in_the_middle_is_replaced_by_one_that_comes() {
    let fakes = plant(gripper("gripper"));
    *fakes.dies_at.lock().unwrap() = Some("gripper.Grasp");
    *fakes.spare.lock().unwrap() = gripper("vacuum");
    let (run, fakes, told) = executed(fakes, &process()).await;
    assert_eq!((run.outcome, run.plans.len()), (How::Done, 2), "{run:?}");
    let [first, second] = run.plans.as_slice() else {
        panic!("{run:?}")
    };
    assert_eq!((first.outcome, first.retreated), (How::Failed, Some(true)));
    let ended: Vec<_> = first
        .ran
        .iter()
        .map(|ran| (&*ran.step, ran.outcome))
        .collect();
    assert_eq!(
        ended,
        [
            ("MovePickApproachBefore", How::Done),
            ("MovePick", How::Done),
            ("Grasp", How::Lost),
            ("MovePickApproachError", How::Done)
        ]
    );
    assert!(
        first
            .reason
            .as_ref()
            .is_some_and(|why| why.contains("Grasp") && why.contains("the connection broke")),
        "{first:?}"
    );
    assert_eq!(second.outcome, How::Done);
    assert!(
        told.contains(&"Wait") && told.contains(&"MovePickApproachError"),
        "{told:?}"
    );
    let waited = fakes
        .kept
        .lock()
        .unwrap()
        .iter()
        .find_map(|run| run.waits_for.clone())
        .unwrap();
    assert!(
        waited.starts_with("pick needs a skill of nsu=urn:ua-bridge:skills;GraspSkillType"),
        "{waited}"
    );
    assert_eq!(run.waits_for, None);
}

#[tokio::test]
async fn a_robot_that_is_halted_because_the_gripper_is_lost_goes_on_with_the_next_gripper() {
    let fakes = plant(gripper("gripper"));
    *fakes.halted_at.lock().unwrap() = Some("robot.Lin");
    *fakes.spare.lock().unwrap() = gripper("vacuum");
    let (run, ..) = executed(fakes, &process()).await;
    assert_eq!((run.outcome, run.plans.len()), (How::Done, 2), "{run:?}");
    let ended = run.plans[0].ran.iter().map(|ran| (&*ran.step, ran.outcome));
    assert_eq!(
        ended.collect::<Vec<_>>(),
        [
            ("MovePickApproachBefore", How::Done),
            ("MovePick", How::Stopped),
            ("MovePickApproachError", How::Done)
        ]
    );
}

#[tokio::test]
async fn a_lost_gripper_that_nothing_replaces_ends_the_run_with_both_reasons() {
    let fakes = plant(gripper("gripper"));
    *fakes.dies_at.lock().unwrap() = Some("gripper.Release");
    let (run, ..) = executed(fakes, &process()).await;
    assert_eq!(run.outcome, How::Failed);
    let reason = run.reason.unwrap();
    assert!(
        reason.contains("the connection broke") && reason.contains("nobody came in 0.3 s"),
        "{reason}"
    );
}

#[tokio::test]
async fn no_other_robot_begins_where_one_may_still_stand() {
    let fakes = plant(gripper("gripper"));
    *fakes.dies_at.lock().unwrap() = Some("robot.Lin");
    fakes.spare.lock().unwrap().extend([
        offer("other", "Ptp", "PtpMoveSkillType"),
        offer("other", "Lin", "LinearMoveSkillType"),
    ]);
    let (run, ..) = executed(fakes, &process()).await;
    assert_eq!(
        (run.outcome, run.plans.len(), run.plans[0].retreated),
        (How::Failed, 1, Some(false)),
        "{run:?}"
    );
    assert!(run.reason.unwrap().contains("has not retreated"));
}

#[tokio::test]
async fn a_skill_that_fails_or_cannot_be_reached_is_not_tried_again() {
    let mut fakes = plant(
        [
            gripper("a-gripper"),
            gripper("b-gripper"),
            gripper("c-gripper"),
        ]
        .concat(),
    );
    fakes.unreachable = Some("a-gripper");
    fakes.fails_at = Some("b-gripper.Grasp");
    let (run, ..) = executed(fakes, &process()).await;
    assert_eq!(run.outcome, How::Done);
    let used: Vec<_> = run
        .plans
        .iter()
        .map(|plan| plan.plan.chosen(SkillRole::Grasp).unwrap())
        .collect();
    assert_eq!(
        used,
        [
            "urn:example:a-gripper#Grasp",
            "urn:example:b-gripper#Grasp",
            "urn:example:c-gripper#Grasp"
        ]
    );
    assert_eq!(
        (
            run.plans[1].ran[2].step.as_str(),
            run.plans[1].ran[2].outcome
        ),
        ("Grasp", How::Failed)
    );
}
