//! Completed steps that are undone.

use std::sync::atomic::Ordering;

use super::stops::StopAt;
use super::*;

#[tokio::test]
async fn completed_steps_are_compensated_in_reverse_order() {
    let mut fakes = drilling(&["drill"]);
    fakes.fails_at = Some("drill.Drill");
    let (run, fakes, told) = executed(fakes, &drills()).await;
    let journal = [
        "gripper.Grasp",
        "robot.Lin",
        "drill.Drill",
        "closed",
        "robot.Ptp",
        "closed",
        "gripper.Release",
        "closed",
    ];
    assert_eq!(*fakes.journal.lock().unwrap(), journal);
    assert_eq!(run.outcome, How::Failed);
    let reason = run.reason.clone().unwrap();
    let ends = reason.ends_with("; compensated: `move`, `grip`");
    assert!(
        reason.starts_with("drill: drill.Drill nothing was gripped") && ends,
        "{reason}"
    );
    let [plan, undo] = run.plans.as_slice() else {
        panic!("{run:?}")
    };
    assert_eq!((plan.outcome, undo.outcome), (How::Failed, How::Done));
    let of = |ran: &crate::record::SkillRun| (ran.step.clone(), ran.of.clone());
    let pair = |step: &str, of: &str| (step.to_owned(), of.to_owned());
    let expected = [
        pair("compensation 1", "move"),
        pair("compensation 0", "grip"),
    ];
    assert_eq!(undo.ran.iter().map(of).collect::<Vec<_>>(), expected);
    assert!(undo.compensates && told.contains(&"Compensate"));
    assert!(fakes.leases.lock().unwrap().is_empty());
    let knowledge = Knowledge::new().unwrap();
    let source = KnowledgeSource::new(SourceKind::Run, &run.run);
    knowledge.replace(&source, &run.triples(), 1).unwrap();
    let rows = knowledge.ask("run-steps", &[]).unwrap().rows;
    let undone = rows.iter().filter(|row| row["compensates"] == true);
    assert_eq!(undone.count(), 2, "{rows:?}");
}

#[tokio::test]
async fn a_compensation_with_an_unknown_outcome_stops_the_others() {
    let ends = [
        (
            Ok(unconfirmed("halted; the outcome is unknown: no answer")),
            How::Unknown,
        ),
        (Ok(failed("it is jammed")), How::Failed),
    ];
    for (end, outcome) in ends {
        let mut fakes = drilling(&["drill"]);
        fakes.fails_at = Some("drill.Drill");
        fakes.ends = Some(("robot.Ptp", Some(end)));
        let (run, fakes, _) = executed(fakes, &drills()).await;
        assert_eq!(run.outcome, outcome, "{run:?}");
        let reason = run.reason.unwrap();
        let said = reason.contains("the compensation of `move` failed: compensation 1: robot.Ptp");
        assert!(
            said && reason.contains("not compensated: `grip`"),
            "{reason}"
        );
        assert_eq!(run.plans[1].outcome, outcome);
        let journal = fakes.journal.lock().unwrap();
        assert!(
            !journal.contains(&"gripper.Release".to_owned()),
            "{journal:?}"
        );
    }
}

#[tokio::test]
async fn nothing_is_compensated_while_a_skill_may_go_on_or_after_a_stop() {
    let unknown = Ok(unconfirmed("halted; the outcome is unknown: no answer"));
    let lost = Err(SkillFault::Lost("the connection broke".into()));
    for end in [unknown, lost] {
        let mut fakes = drilling(&["drill", "other"]);
        fakes.ends = Some(("drill.Drill", Some(end)));
        let (run, fakes, _) = executed(fakes, &drills()).await;
        let reason = run.reason.unwrap();
        let said = "not compensated, because the end of a skill is not confirmed: `move`, `grip`";
        assert!(reason.contains(said), "{reason}");
        assert_eq!(
            fakes.journal.lock().unwrap().len(),
            4,
            "no other drill repeats the step"
        );
    }
    // The drill does not end by itself.
    let mut fakes = drilling(&[]);
    fakes.ends = None;
    let slow = Process {
        wait: Duration::from_secs(600),
        ..drills()
    };
    let mut slow = slow;
    slow.steps[2].needs[0].skill_type = Some(ParameterType::own("PtpMoveSkillType"));
    let fakes = Arc::new(Fakes {
        halted_at: Mutex::new(Some("robot.Ptp")),
        ..fakes
    });
    let as_plant: Arc<dyn Plant> = Arc::new(Arc::clone(&fakes));
    let teller = StopAt("Third", watch::channel(false).0);
    let counted = Third(teller, AtomicU64::new(0));
    let run = execute(&as_plant, &slow, 1, &counted);
    let run = tokio::time::timeout(Duration::from_secs(20), run)
        .await
        .unwrap();
    let reason = run.reason.unwrap();
    assert!(
        reason.contains("not compensated, because it was stopped: `move`, `grip`"),
        "{reason}"
    );
}

/// Stops the run at its third step.
struct Third(StopAt, AtomicU64);

#[async_trait]
impl JobObserver for Third {
    async fn step(&self, step: &'static str) {
        if step == "Step" && self.1.fetch_add(1, Ordering::Relaxed) == 2 {
            self.0.step("Third").await;
        }
    }

    async fn stopped(&self) {
        self.0.stopped().await;
    }
}
