//! Runs whose end is not known.

use super::*;

#[tokio::test]
async fn a_run_whose_end_is_unknown_has_no_end_and_is_repeated_by_nobody() {
    let refused = SkillFault::Refused {
        status: "BadUserAccessDenied".into(),
        text: "Halt of gripper.Grasp".into(),
    };
    let ends = [
        Err(SkillFault::NotHalted("whether it moves is unknown".into())),
        Err(SkillFault::Unexpected("its outcome is of run 7".into())),
        Err(refused.clone()),
        // The flag counts, and not the words of the message.
        Ok(unconfirmed("halted, and nothing was received after that")),
    ];
    for process in [grasps(), process()] {
        for end in &ends {
            let mut fakes = plant([gripper("gripper"), gripper("other")].concat());
            fakes.ends = Some(("gripper.Grasp", Some(end.clone())));
            let process = Process {
                // The time is over when the Halt is refused.
                within: match *end == Err(refused.clone()) {
                    true => Duration::ZERO,
                    false => process.within,
                },
                ..process.clone()
            };
            let told = Unknowns::default();
            let fakes = Arc::new(fakes);
            let as_plant: Arc<dyn Plant> = Arc::new(Arc::clone(&fakes));
            let run = execute(&as_plant, &process, 1, &told).await;
            assert_eq!((run.outcome, run.plans.len()), (How::Unknown, 1), "{run:?}");
            let plan = &run.plans[0];
            let mut grasps = plan.ran.iter().filter(|ran| ran.skill.ends_with("#Grasp"));
            let grasp = grasps.next().unwrap();
            assert_eq!((grasp.outcome, grasp.ended_ms), (How::Unknown, None));
            assert_eq!((grasps.next(), plan.outcome), (None, How::Unknown));
            let reason = run.reason.clone().unwrap();
            assert!(reason.contains("unknown"));
            assert_eq!(told.0.lock().unwrap().last(), Some(&reason));
            let status = serde_json::to_value(&run).unwrap();
            assert_eq!(status["outcome"], "unknown");
            let triples = run.triples();
            let ended = triples
                .iter()
                .filter(|triple| triple.predicate.ends_with("#endedAtTime"));
            let done = plan.ran.iter().filter(|ran| ran.outcome == How::Done);
            assert_eq!(ended.count(), done.count());
            let knowledge = Knowledge::new().unwrap();
            let source = KnowledgeSource::new(SourceKind::Run, &run.run);
            knowledge.replace(&source, &triples, 1).unwrap();
            let steps = knowledge.ask("run-steps", &[]).unwrap().rows;
            let mut unknown = steps.iter().filter(|row| row["outcome"] == "unknown");
            let unknown = unknown.next().unwrap();
            assert_eq!(unknown["skill"], "urn:example:gripper#Grasp");
            assert!(unknown.get("ended").is_none_or(serde_json::Value::is_null));
        }
    }
}

/// Keeps the reasons for which ends are unknown.
#[derive(Default)]
struct Unknowns(Mutex<Vec<String>>);

#[async_trait]
impl JobObserver for Unknowns {
    async fn step(&self, _step: &'static str) {}

    async fn unknown(&self, why: &str) {
        self.0.lock().unwrap().push(why.to_owned());
    }
}

#[tokio::test]
async fn a_refused_start_is_no_unknown_end_and_another_component_does_the_step() {
    let mut fakes = plant([gripper("gripper"), gripper("other")].concat());
    let refused = SkillFault::Refused {
        status: "BadInvalidState".into(),
        text: "it is Suspended".into(),
    };
    fakes.ends = Some(("gripper.Grasp", Some(Err(refused))));
    let (run, ..) = executed(fakes, &grasps()).await;
    assert_eq!((run.outcome, run.plans.len()), (How::Done, 2), "{run:?}");
    assert_eq!(run.plans[0].ran[0].outcome, How::Failed);
}

#[tokio::test]
async fn a_skill_that_runs_when_its_process_is_given_up_has_an_unknown_end() {
    let mut fakes = plant(gripper("gripper"));
    fakes.ends = Some(("gripper.Grasp", None));
    let fakes = Arc::new(fakes);
    let as_plant: Arc<dyn Plant> = Arc::new(Arc::clone(&fakes));
    let (process, told) = (grasps(), |_: &'static str| {});
    let run = execute(&as_plant, &process, 1, &told);
    let given_up = tokio::time::timeout(Duration::from_millis(100), run).await;
    assert!(given_up.is_err());
    let kept = fakes.kept.lock().unwrap();
    let run = kept.last().unwrap();
    assert_eq!(run.outcome, How::Unknown);
    let ran = &run.plans[0].ran[0];
    assert_eq!((ran.outcome, ran.ended_ms), (How::Unknown, None));
    assert!(run.ended_ms.is_some() && run.plans[0].outcome == How::Unknown);
}
