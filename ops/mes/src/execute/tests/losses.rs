//! A device that is lost or fails in each step of a process: the outcome and the reason name the
//! step, completed steps are compensated or named, and nothing starts afterwards.

use super::fakes::Mishap;
use super::*;

const CHANGER: &str = "urn:example:changer";
const ROBOT: &str = "urn:example:robot";

/// The steps of the process: the name, the skill and its component.
const STEPS: [(&str, &str, &str); 5] = [
    ("attach", "changer.Change", CHANGER),
    ("pick", "gripper.Grasp", GRIPPER),
    ("move", "robot.Lin", ROBOT),
    ("place", "gripper.Release", GRIPPER),
    ("detach", "changer.Detach", CHANGER),
];

/// A process that attaches a gripper, picks, moves, places, and detaches the gripper. The first
/// three steps can be undone.
fn handles() -> Process {
    let mut steps = vec![
        alone(0, "attach", "ChangeToolSkillType"),
        alone(1, "pick", "GraspSkillType"),
        alone(2, "move", "LinearMoveSkillType"),
        alone(3, "place", "ReleaseSkillType"),
        alone(4, "detach", "DetachToolSkillType"),
    ];
    steps[0].parameters.push(GivenParameter {
        name: "ToolAppUri".into(),
        value: GRIPPER.into(),
        unit: None,
        result: None,
        query: None,
    });
    for step in [1, 3] {
        steps[step].by = By::AttachedTool;
    }
    for (step, undo) in [
        (0, "DetachToolSkillType"),
        (1, "ReleaseSkillType"),
        (2, "PtpMoveSkillType"),
    ] {
        steps[step].compensation = undone_by(step, 5, undo);
    }
    Process { steps, ..grasps() }
}

fn handling() -> Fakes {
    let mut offers = gripper("gripper");
    offers.push(offer("changer", "Change", "ChangeToolSkillType"));
    offers.push(offer("changer", "Detach", "DetachToolSkillType"));
    plant(offers)
}

/// Returns the skills that ran, without their parameters.
fn ran(fakes: &Fakes) -> Vec<String> {
    let journal = fakes.journal.lock().unwrap();
    let ran = journal.iter().filter(|line| *line != "closed");
    ran.filter_map(|line| line.split(' ').next())
        .map(str::to_owned)
        .collect()
}

/// Executes a process. Returns the run, its reason and the skills that ran, after checks that hold
/// for each run that is not done: it has ended, nothing starts later, and its components are free
/// unless a machine may still move.
async fn failed_run(fakes: Fakes, process: &Process) -> (ProcessRun, String, Vec<String>) {
    let (run, fakes, _) = executed(fakes, process).await;
    let before = ran(&fakes);
    tokio::time::sleep(Duration::from_secs(24 * 3600)).await;
    assert_eq!(ran(&fakes), before, "a skill starts after the run");
    let is_unknown = run.outcome == How::Unknown;
    assert!(is_unknown || run.outcome == How::Failed, "{run:?}");
    assert!(run.ended_ms.is_some() && run.waits_for.is_none(), "{run:?}");
    assert_eq!(fakes.kept.lock().unwrap().last(), Some(&run));
    assert_eq!(fakes.leases.lock().unwrap().is_empty(), !is_unknown);
    let running = run.plans.iter().flat_map(|plan| &plan.ran);
    let mut running = running.filter(|ran| ran.outcome == How::Running);
    assert_eq!(running.next(), None, "a record goes on");
    let reason = run.reason.clone().unwrap();
    (run, reason, before)
}

#[tokio::test(start_paused = true)]
async fn without_an_incident_each_step_is_done_in_its_order() {
    let (run, fakes, _) = executed(handling(), &handles()).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    assert_eq!(ran(&fakes), STEPS.map(|(_, skill, _)| skill));
}

#[tokio::test(start_paused = true)]
async fn a_device_that_is_lost_in_a_step_is_named_and_nothing_is_undone_meanwhile() {
    let not_halted = SkillFault::NotHalted("whether it moves is unknown".into());
    let not_undone = "; not compensated, because the end of a skill is not confirmed: ";
    for (mishap, why, outcome, of_skill) in [
        (
            Mishap::Lost,
            "its component is lost: the connection broke",
            How::Failed,
            How::Lost,
        ),
        (
            Mishap::Ends(Err(not_halted)),
            "whether it moves is unknown",
            How::Unknown,
            How::Unknown,
        ),
    ] {
        for (number, (step, skill, component)) in STEPS.into_iter().enumerate() {
            let fakes = handling();
            fakes.mishaps.lock().unwrap().insert(number, mishap.clone());
            let (run, reason, ran) = failed_run(fakes, &handles()).await;
            assert_eq!((run.outcome, run.plans.len()), (outcome, 1), "{reason}");
            let begins = format!("{step}: {skill} {why}");
            assert!(reason.starts_with(&begins), "{reason}");
            let last = run.plans[0].ran.last().unwrap();
            assert_eq!(
                (&*last.step, &*last.component, last.outcome),
                (step, component, of_skill)
            );
            assert!(last.reason.is_some(), "{last:?}");
            assert_eq!(ran.len(), number + 1, "no skill runs after it: {ran:?}");
            let undone = [
                "",
                "`attach`",
                "`pick`, `attach`",
                "`move`, `pick`, `attach`",
            ];
            let undone = undone[number.min(3)];
            let expected = match number {
                0 => begins,
                4 => format!("{begins}; without a compensation: `place`{not_undone}{undone}"),
                _ => format!("{begins}{not_undone}{undone}"),
            };
            assert_eq!(reason, expected);
        }
    }
}

#[tokio::test(start_paused = true)]
async fn the_completed_steps_are_undone_when_a_step_fails() {
    let too_late = SkillFault::TimedOut(Duration::from_secs(5));
    for (end, why) in [
        (Ok(failed("the motor stalls")), "the motor stalls"),
        (Err(too_late), "it did not end within 5s and was halted"),
    ] {
        // The skills that run after the incident, and the end of the reason.
        for (number, (after, told)) in [
            (&[][..], ""),
            (&["changer.Detach"][..], "; compensated: `attach`"),
            (
                &["gripper.Release", "changer.Detach"],
                "; compensated: `pick`, `attach`",
            ),
            (
                &["robot.Ptp", "gripper.Release", "changer.Detach"],
                "; compensated: `move`, `pick`, `attach`",
            ),
            // It is not known whether the gripper is attached, so that it must not be used.
            (&["robot.Ptp"], "; not compensated: `attach`"),
        ]
        .into_iter()
        .enumerate()
        {
            let (step, skill, _) = STEPS[number];
            let fakes = handling();
            fakes
                .mishaps
                .lock()
                .unwrap()
                .insert(number, Mishap::Ends(end.clone()));
            let (run, reason, ran) = failed_run(fakes, &handles()).await;
            assert_eq!(run.outcome, How::Failed);
            let begins = format!("{step}: {skill} {why}");
            assert!(reason.starts_with(&begins), "{reason}");
            assert!(reason.ends_with(told), "{reason}");
            assert_eq!(reason.contains("compensated: "), number > 0, "{reason}");
            let left = "; without a compensation: `place`; ";
            assert_eq!(reason.contains(left), number == 4, "{reason}");
            let undone = "the compensation of `pick` failed: gripper: ";
            assert_eq!(reason.contains(undone), number == 4, "{reason}");
            assert_eq!(ran[number + 1..], *after, "{reason}");
            let last = &run.plans[0].ran[number];
            assert_eq!((&*last.step, last.outcome), (step, How::Failed));
        }
    }
}

#[tokio::test(start_paused = true)]
async fn a_device_that_is_lost_before_its_step_is_named_and_the_completed_steps_are_undone() {
    for (number, (after, told)) in [
        (&[][..], ""),
        (&["changer.Detach"][..], "; compensated: `attach`"),
        (
            &["gripper.Release", "changer.Detach"],
            "; compensated: `pick`, `attach`",
        ),
        // The device of a compensation is lost too.
        (
            &["robot.Ptp"],
            "the compensation of `pick` failed: compensation 1: gripper.Release its component is \
             lost: the connection broke; not compensated: `attach`",
        ),
        (
            &["robot.Ptp", "gripper.Release"],
            "the compensation of `attach` failed: compensation 0: changer.Detach its component is \
             lost: the connection broke",
        ),
    ]
    .into_iter()
    .enumerate()
    {
        let (step, skill, component) = STEPS[number];
        let fakes = handling();
        match number.checked_sub(1) {
            Some(before) => {
                fakes
                    .mishaps
                    .lock()
                    .unwrap()
                    .insert(before, Mishap::Loses(component));
            }
            // The plan still knows it.
            None => fakes
                .lost
                .send_modify(|lost| lost.push(component.to_owned())),
        }
        let (run, reason, ran) = failed_run(fakes, &handles()).await;
        assert_eq!(run.outcome, How::Failed);
        let begins = format!("{step}: {skill} its component is lost: the connection broke; ");
        assert!(reason.starts_with(&begins), "{reason}");
        let missing = format!("{step} needs a skill of nsu=urn:ua-bridge:skills;");
        assert!(reason.contains(&missing), "{reason}");
        let left = "; without a compensation: `place`; ";
        assert_eq!(reason.contains(left), number == 4, "{reason}");
        assert!(reason.ends_with(told), "{reason}");
        assert_eq!(ran[number..], *after, "{reason}");
        assert!(!ran[..number].contains(&skill.to_owned()) || step == "place");
    }
}

#[tokio::test(start_paused = true)]
async fn a_device_that_is_lost_in_a_compensation_ends_the_compensation() {
    let fails = Mishap::Ends(Ok(failed("the motor stalls")));
    for (number, undo, left) in [
        (0, "robot.Ptp", "; not compensated: `pick`, `attach`"),
        (1, "gripper.Release", "; not compensated: `attach`"),
        (2, "changer.Detach", ""),
    ] {
        // The step that fails is the fourth; the compensations follow it.
        let fakes = handling();
        let mishaps = [(3, fails.clone()), (4 + number, Mishap::Lost)];
        fakes.mishaps.lock().unwrap().extend(mishaps);
        let (run, reason, ran) = failed_run(fakes, &handles()).await;
        assert_eq!(run.outcome, How::Failed);
        let [_, .., last] = run.plans.as_slice() else {
            panic!("{run:?}");
        };
        let undone = ["move", "pick", "attach"][number];
        let said = format!("the compensation of `{undone}` failed: ");
        assert!(reason.contains(&said), "{reason}");
        let lost = format!("{undo} its component is lost: the connection broke{left}");
        assert!(reason.ends_with(&lost), "{reason}");
        assert_eq!(ran.len(), 5 + number, "{ran:?}");
        assert!(last.compensates);
        assert_eq!(last.ran.last().map(|ran| ran.outcome), Some(How::Lost));
    }
}

#[tokio::test(start_paused = true)]
async fn a_composite_names_its_step_and_whether_the_robot_has_retreated() {
    let not_halted = SkillFault::NotHalted("whether it moves is unknown".into());
    let stalls = Mishap::Ends(Ok(failed("the motor stalls")));
    for (mishap, outcome) in [
        (Mishap::Lost, How::Failed),
        (stalls, How::Failed),
        (Mishap::Ends(Err(not_halted)), How::Unknown),
    ] {
        for (number, step) in [
            "MovePickApproachBefore",
            "MovePick",
            "Grasp",
            "MovePickApproachAfter",
            "MovePlaceApproachBefore",
            "MovePlace",
            "Release",
            "MovePlaceApproachAfter",
        ]
        .into_iter()
        .enumerate()
        {
            let fakes = plant(gripper("gripper"));
            fakes.mishaps.lock().unwrap().insert(number, mishap.clone());
            let (run, reason, ran) = failed_run(fakes, &process()).await;
            assert_eq!(run.outcome, outcome, "{reason}");
            assert!(reason.starts_with(&format!("{step}: ")), "{reason}");
            let retreated = run.plans[0].retreated.unwrap();
            let told = match retreated {
                true => "; the robot has retreated",
                false => "; the robot has not retreated: ",
            };
            assert!(reason.contains(told), "{reason}");
            // At most the retreat follows, and only of a robot whose end is known.
            let is_robot = matches!(&*ran[number], "robot.Ptp" | "robot.Lin");
            let may_move = is_robot && !matches!(mishap, Mishap::Ends(Ok(_)));
            let follows = &ran[number + 1..];
            assert!(!may_move || follows.is_empty(), "{step}: {ran:?}");
            assert!(follows.len() <= 1, "{step}: {ran:?}");
            assert!(follows.iter().all(|skill| skill.starts_with("robot.")));
            assert_eq!(retreated, !may_move, "{reason}");
        }
    }
}
