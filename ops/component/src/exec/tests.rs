use std::path::{Path, PathBuf};

use skills::conformance;

use super::*;

struct Scripts(PathBuf);

impl Scripts {
    fn new(name: &str) -> Self {
        let folder = std::env::temp_dir().join(format!("exec-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        Self(folder)
    }

    /// Returns a driver that runs this shell script, and one that stops the machine.
    fn driver(&self, script: &str) -> std::sync::Arc<dyn Driver> {
        let text = "component: x\napplication_uri: urn:x\nnamespace: 1\nskills:\n  - name: Grasp\n    type: GraspSkillType\n    driver:\n      \
             exec:\n        command: [/bin/sh, run.sh]\n        stop: [/bin/sh, -c, 'echo stopped >> stopped']\n        halt_timeout: 300 ms\n";
        std::fs::write(self.0.join("run.sh"), script).unwrap();
        let component = Component::from_yaml(text, &self.0)
            .unwrap_or_else(|findings| panic!("{}", findings.render("x", text)));
        let component = with_programs(component);
        let DriverSetup::Given(driver) = component.skills[0].driver.clone() else {
            panic!("another driver");
        };
        driver
    }

    fn was_stopped(&self) -> bool {
        self.0.join("stopped").is_file()
    }
}

impl Drop for Scripts {
    fn drop(&mut self) {
        // The folder of a failed test is left to the operating system.
        let _removed = std::fs::remove_dir_all(&self.0);
    }
}

/// Reads the start, and works until it is halted or done.
const OBEYS: &str = r#"read -r start
echo "$start" > start
echo '{"progress": 0.5, "step": "Close", "note": "half"}'
(sleep 0.2; echo '{"result": {"Gripped": true}}') &
worker=$!
read -r halt && kill $worker && echo '{"failed": "halted"}'
"#;

#[tokio::test]
async fn a_program_that_obeys_is_as_a_driver_should_be_and_gets_the_parameters() {
    let scripts = Scripts::new("obeys");
    let driver = scripts.driver(OBEYS);
    let force = vec![("Force".to_owned(), SkillValue::from(7.5))];
    let outcome = conformance::run_once("GraspSkillType", driver.clone(), force).await;
    let outcome = outcome.unwrap();
    assert!(outcome.succeeded, "{}", outcome.message);
    assert_eq!(
        outcome.results,
        [("Gripped".to_owned(), SkillValue::from(true))]
    );
    let traced = |what: &str| outcome.trace.iter().any(|line| line.ends_with(what));
    assert!(traced(" Close") && traced(" half"), "{:?}", outcome.trace);
    let start = std::fs::read_to_string(scripts.0.join("start")).unwrap();
    let start: Json = serde_json::from_str(&start).unwrap();
    assert_eq!(
        start,
        json!({"start": {"skill": "Grasp", "run": 1, "parameters": {"Force": 7.5}}})
    );
    conformance::check("GraspSkillType", driver, Vec::new)
        .await
        .unwrap();
    assert!(!scripts.was_stopped());
}

#[tokio::test]
async fn a_program_that_ends_or_talks_otherwise_leaves_an_unknown_machine_that_is_stopped() {
    let cases = [
        (
            "exit 3",
            "it has ended without a result; the `stop` command is done",
        ),
        (
            "echo starts >&2; echo no port >&2; exit 3",
            "without a result, and its last error is `no port`; the `stop` command is done",
        ),
        (
            "echo hello; sleep 60",
            "its line `hello` is not a JSON object",
        ),
        ("echo '{\"progres\": 1}'; sleep 60", "has the key `progres`"),
        ("echo '{\"progress\": 7}'; sleep 60", "is not from 0 to 1"),
        (
            "head -c 70000 /dev/zero | tr '\\0' x; sleep 60",
            "a line of more than 65536 bytes",
        ),
    ];
    for (number, (script, expected)) in cases.into_iter().enumerate() {
        let scripts = Scripts::new(&format!("other-{number}"));
        let driver = scripts.driver(script);
        let outcome = conformance::run_once("GraspSkillType", driver, Vec::new()).await;
        let outcome = outcome.unwrap();
        assert!(
            !outcome.succeeded && outcome.message.contains(expected),
            "{script}: {}",
            outcome.message
        );
        assert!(scripts.was_stopped(), "{script}");
    }
    let scripts = Scripts::new("failed");
    let driver = scripts.driver("echo '{\"failed\": \"no part\"}'");
    let outcome = conformance::run_once("GraspSkillType", driver, Vec::new()).await;
    assert_eq!(outcome.unwrap().message, "no part");
    assert!(!scripts.was_stopped());
}

#[tokio::test]
async fn a_program_that_does_not_halt_is_killed_with_its_group_and_start_waits_for_a_reset() {
    use skills::{Authority, ParameterType, Skill, SkillDescription, SkillOwner, model};

    let scripts = Scripts::new("deaf");
    let script = "trap '' TERM\nsh -c 'echo $$ > child; exec sleep 600' &\necho '{\"step\": \"Deaf\"}'\nsleep 600\n";
    let of = model::find("GraspSkillType").unwrap();
    let facts = SkillDescription {
        name: "Grasp".to_owned(),
        types: vec![ParameterType::own(of.name)],
        parameters: of.parameters(),
        results: of.results(),
        capabilities: Vec::new(),
        timeout: None,
        rests_in: of.rests_in,
    };
    let skill = Skill::spawn(facts, scripts.driver(script), Authority::new(), Vec::new());
    let by = SkillOwner::Local("the test");
    skill
        .call(by.clone(), program::ProgramMethod::Reset)
        .await
        .unwrap();
    skill.start_with(by.clone(), Vec::new()).await.unwrap();
    let soon = Duration::from_secs(60);
    let mut watch = skill.watch();
    let child = scripts.0.join("child");
    let running = watch.wait_for(|shown| shown.step == "Deaf");
    timeout(soon, running).await.unwrap().unwrap();
    let pid = async {
        loop {
            let text = std::fs::read_to_string(&child).unwrap_or_default();
            if let Ok(pid) = text.trim().parse::<u32>() {
                return pid;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    let pid = timeout(soon, pid).await.unwrap();
    skill
        .call(by.clone(), program::ProgramMethod::Halt)
        .await
        .unwrap();
    let halted = watch.wait_for(|shown| shown.state == program::ProgramMachineState::Halted);
    let shown = timeout(soon, halted).await.unwrap().unwrap().clone();
    let message = &shown.outcome.as_ref().unwrap().message;
    assert!(
        message.contains("has not halted within 300ms and was killed"),
        "{message}"
    );
    assert!(shown.needs_reset && scripts.was_stopped());
    let is_left = || {
        let stat = std::fs::read_to_string(Path::new("/proc").join(pid.to_string()).join("stat"));
        stat.is_ok_and(|stat| !stat.contains(") Z "))
    };
    let gone = async {
        while is_left() {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    timeout(soon, gone).await.unwrap();
}

#[test]
fn a_line_is_progress_or_the_end() {
    let results = vec![
        ("Torque".to_owned(), SkillValue::from(1.5)),
        ("Values".to_owned(), SkillValue::from(vec![1.0, 2.0])),
    ];
    assert_eq!(
        reported(r#"{"result": {"Torque": 1.5, "Values": [1, 2]}}"#),
        Ok(Report::Ended(Ok(results)))
    );
    for wrong in [
        "[]",
        r#"{"result": 1}"#,
        r#"{"result": {"a": null}}"#,
        r#"{"step": 1}"#,
        r#"{"failed": true}"#,
    ] {
        assert!(reported(wrong).is_err(), "{wrong}");
    }
}

#[path = "../../examples/own_gripper.rs"]
mod example;

/// Returns the lines of the example program for these lines of the component.
fn lines_of_the_example(action: &str, lines: &[Json], halts: bool) -> Vec<Json> {
    let (sender, receiver) = std::sync::mpsc::channel();
    for line in lines {
        sender.send(line.to_string()).unwrap();
    }
    // The end of the input halts the program.
    let _open = (!halts).then_some(sender);
    let mut said = Vec::new();
    example::run(action, &receiver, |message| said.push(message)).unwrap();
    said
}

#[test]
fn the_example_in_rust_speaks_the_lines_of_programs() {
    let start = json!({"start": {"skill": "Grasp", "run": 1, "parameters": {"Force": 7.5}}});
    let said = lines_of_the_example("grasp", std::slice::from_ref(&start), false);
    let said: Vec<Report> = said
        .iter()
        .map(|line| reported(&line.to_string()).unwrap())
        .collect();
    let gripped = vec![("Gripped".to_owned(), SkillValue::from(true))];
    assert_eq!(said.last(), Some(&Report::Ended(Ok(gripped))));
    assert_eq!(said.len(), 12);
    let said = lines_of_the_example("grasp", &[start], true);
    let last = reported(&said.last().unwrap().to_string()).unwrap();
    assert_eq!(last, Report::Ended(Err("halted at 10 %".to_owned())));
}

#[test]
fn the_schema_has_the_keys_that_are_read() {
    let schema: Json = serde_json::from_str(SCHEMA).unwrap();
    let lines = schema["$defs"]["from_skill"]["oneOf"].as_array().unwrap();
    let keys = lines
        .iter()
        .flat_map(|line| line["properties"].as_object().unwrap().keys());
    let mut keys: Vec<&str> = keys.map(String::as_str).collect();
    let mut known = KEYS.to_vec();
    keys.sort_unstable();
    known.sort_unstable();
    assert_eq!(keys, known);
}
