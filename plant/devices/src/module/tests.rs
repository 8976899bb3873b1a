//! Runs of procedures with a simulated module in memory.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use async_trait::async_trait;
use mtp::pea::{Pea, PeaFaults, PeaValue};
use mtp::state::{Command, State};
use mtp::{Module, OpcUaNode};
use plant_opcua::client::ClientError;
use program::ProgramMethod;
use skills::{RunOutcome, Skill, SkillOwner, SkillValue};

use super::{HandshakeTiming, ModuleNodeError, ModuleNodes, ModuleSettings, ProcessModule};

/// A module in memory.
struct Memory {
    pea: Mutex<(Pea, tokio::time::Instant)>,
    /// The commands that clients wrote.
    commands: Mutex<Vec<u32>>,
    is_silent: std::sync::atomic::AtomicBool,
}

impl Memory {
    fn new(pea: Pea) -> Arc<Self> {
        Arc::new(Self {
            pea: Mutex::new((pea, tokio::time::Instant::now())),
            commands: Mutex::default(),
            is_silent: std::sync::atomic::AtomicBool::new(false),
        })
    }

    fn with<T>(&self, act: impl FnOnce(&mut Pea) -> T) -> T {
        let mut pea = self.pea.lock().unwrap();
        let now = tokio::time::Instant::now();
        let passed = now - pea.1;
        pea.1 = now;
        pea.0.advance(passed);
        act(&mut pea.0)
    }

    fn commands(&self) -> Vec<String> {
        let words = self.commands.lock().unwrap();
        words
            .iter()
            .filter_map(|word| Command::of_bit(*word))
            .map(|command| command.to_string())
            .collect()
    }

    fn answer(&self) -> Result<(), ModuleNodeError> {
        match self.is_silent.load(std::sync::atomic::Ordering::SeqCst) {
            true => Err(ClientError::Lost("no response".to_owned()).into()),
            false => Ok(()),
        }
    }
}

#[async_trait]
impl ModuleNodes for Memory {
    async fn connect(&self, _node: &OpcUaNode, _within: Duration) -> Result<(), ModuleNodeError> {
        self.answer()
    }

    async fn read(&self, nodes: &[&OpcUaNode]) -> Result<Vec<Option<SkillValue>>, ModuleNodeError> {
        self.answer()?;
        let read = |node: &&OpcUaNode| {
            let value = self.with(|pea| pea.value(&node.item).cloned())?;
            Some(match value {
                PeaValue::Boolean(value) => SkillValue::Boolean(value),
                PeaValue::Byte(value) => SkillValue::Byte(value),
                PeaValue::Word(value) => SkillValue::UInt32(value),
                PeaValue::Integer(value) => SkillValue::Int32(value),
                PeaValue::Number(value) => SkillValue::Float(value),
                PeaValue::Text(value) => SkillValue::String(value),
            })
        };
        Ok(nodes.iter().map(read).collect())
    }

    async fn write(&self, node: &OpcUaNode, value: SkillValue) -> Result<(), ModuleNodeError> {
        self.answer()?;
        if let SkillValue::UInt32(word) = value
            && node.id().contains("CommandExt")
            && word != 0
        {
            self.commands.lock().unwrap().push(word);
        }
        let known = self.with(|pea| pea.value(&node.item).cloned());
        let value = match (known, value) {
            #[expect(clippy::cast_possible_truncation, reason = "values of the test")]
            (Some(PeaValue::Number(_)), value) => {
                PeaValue::Number(value.as_f64().unwrap_or_default() as f32)
            }
            (_, SkillValue::Boolean(value)) => PeaValue::Boolean(value),
            (_, SkillValue::UInt32(value)) => PeaValue::Word(value),
            (_, SkillValue::Int32(value)) => PeaValue::Integer(value),
            (_, SkillValue::String(value)) => PeaValue::Text(value),
            (_, value) => {
                let shape = value.shape();
                return Err(ModuleNodeError::WrongType { value, shape });
            }
        };
        self.with(|pea| pea.write(&node.item, value))
            .map_err(|refusal| ClientError::Lost(refusal.to_string()).into())
    }
}

fn stage() -> Module {
    Module::read(&test_data::read_own("mtp/stage.aml")).unwrap()
}

/// Time limits that a loaded machine does not reach.
fn patient() -> HandshakeTiming {
    HandshakeTiming {
        connect: Duration::from_secs(30),
        handshake: Duration::from_secs(30),
        stop: Duration::from_secs(30),
        lost: Duration::from_millis(300),
        poll: Duration::from_millis(2),
    }
}

/// Time limits for waits that end without success.
fn short() -> HandshakeTiming {
    HandshakeTiming {
        handshake: Duration::from_millis(200),
        ..patient()
    }
}

/// Returns the skill of a procedure of the stage, and its module.
fn skill(name: &str, faults: PeaFaults, timing: HandshakeTiming) -> (Skill, Arc<Memory>) {
    let module = stage();
    let pea = Pea::new(&module)
        .with_times(Duration::from_millis(10), Duration::from_millis(50))
        .with_faults(faults);
    let memory = Memory::new(pea);
    let settings = ModuleSettings {
        module,
        endpoint: None,
        capabilities: std::collections::BTreeMap::new(),
        configuration: false,
        timing,
    };
    let device = ProcessModule::over(settings, Arc::<Memory>::clone(&memory));
    let mut all = device.skills.iter();
    let found = all.find(|skill| skill.name == name).unwrap();
    (device.spawn(found, Vec::new()).unwrap(), memory)
}

const BY: SkillOwner = SkillOwner::Local("the test");

async fn start(skill: &Skill, parameters: &[(&str, SkillValue)]) {
    if skill.shown().state == program::ProgramMachineState::Halted {
        skill.call(BY, ProgramMethod::Reset).await.unwrap();
    }
    let parameters = parameters
        .iter()
        .map(|(name, value)| ((*name).to_owned(), value.clone()));
    skill.start_with(BY, parameters.collect()).await.unwrap();
}

async fn ended(skill: &Skill) -> RunOutcome {
    let mut watch = skill.watch();
    let is_over = |shown: &Arc<skills::SkillSnapshot>| {
        !matches!(
            shown.state,
            program::ProgramMachineState::Running | program::ProgramMachineState::Suspended
        )
    };
    let ended = watch.wait_for(is_over);
    let shown = tokio::time::timeout(Duration::from_secs(120), ended)
        .await
        .unwrap()
        .unwrap();
    RunOutcome::clone(shown.outcome.as_ref().unwrap())
}

/// Waits until a service has a state.
async fn until(memory: &Memory, service: usize, state: State) {
    for _ in 0..60_000 {
        if memory.with(|pea| pea.state(service)) == Some(state) {
            return;
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    panic!("the service is never {state}");
}

#[tokio::test]
async fn a_service_is_started_by_its_name_and_that_of_a_procedure() {
    let module = stage();
    let memory = Memory::new(Pea::new(&module));
    let settings = ModuleSettings {
        module,
        endpoint: None,
        capabilities: std::collections::BTreeMap::new(),
        configuration: false,
        timing: patient(),
    };
    let device = ProcessModule::over(settings, memory);
    let name =
        |service: &str, procedure: Option<&str>| match device.start(service, procedure, Vec::new())
        {
            Ok(skill) => skill.facts().name.clone(),
            Err(fault) => fault.0,
        };
    assert_eq!(name("Solo", None), "Solo-Waltz", "the default");
    assert_eq!(name("Duet", Some("Tango")), "Duet-Tango");
    assert_eq!(
        name("Duet", Some("Jive")),
        "Duet has no procedure `Jive`; its procedures are Waltz, Tango, Polka"
    );
    let none = name("Trio", None);
    assert!(
        none.contains("`Trio`") && none.contains("Duet, Solo"),
        "{none}"
    );
}

#[tokio::test]
async fn a_procedure_runs_to_its_end_and_again() {
    let (skill, memory) = skill("Solo-Polka", PeaFaults::default(), patient());
    for _ in 0..2 {
        start(&skill, &[]).await;
        let outcome = ended(&skill).await;
        assert!(outcome.succeeded, "{}", outcome.message);
        assert_eq!(memory.with(|pea| pea.state(1)), Some(State::Completed));
    }
    assert_eq!(memory.commands(), ["Start", "Reset", "Start"]);
}

#[tokio::test]
async fn parameters_are_written_applied_and_read_back() {
    let (skill, memory) = skill("Duet-Tango", PeaFaults::default(), patient());
    let module = stage();
    let tango = &module.services[0].procedures[1];
    let names: Vec<&str> = tango.parameters.iter().map(|one| &*one.name).collect();
    assert_eq!(names, ["Tempo", "Turns"]);
    let parameters = [
        ("Tempo", SkillValue::Double(42.1)),
        ("Turns", SkillValue::Int32(7)),
        ("RunTime", SkillValue::Double(0.05)),
    ];
    start(&skill, &parameters).await;
    let outcome = ended(&skill).await;
    assert!(outcome.succeeded, "{}", outcome.message);
    let effective = |at: usize| {
        let node = tango.parameters[at].read.as_ref().unwrap();
        memory.with(|pea| pea.value(&node.item).cloned())
    };
    assert_eq!(effective(0), Some(PeaValue::Number(42.1)));
    assert_eq!(effective(1), Some(PeaValue::Integer(7)));
    // The limit of turns is a node of the module.
    start(
        &skill,
        &[parameters[0].clone(), ("Turns", SkillValue::Int32(700))],
    )
    .await;
    let outcome = ended(&skill).await;
    assert!(
        outcome
            .message
            .contains("Turns is from 1 to 100 in the module, and 700 was given"),
        "{}",
        outcome.message
    );
    assert_eq!(memory.commands(), ["Start", "Complete", "Reset"]);
}

#[tokio::test]
async fn halt_stops_the_service_and_suspend_pauses_it() {
    let (skill, memory) = skill("Duet-Waltz", PeaFaults::default(), patient());
    start(&skill, &[]).await;
    until(&memory, 0, State::Execute).await;
    skill.call(BY, ProgramMethod::Suspend).await.unwrap();
    until(&memory, 0, State::Paused).await;
    skill.call(BY, ProgramMethod::Resume).await.unwrap();
    until(&memory, 0, State::Execute).await;
    skill.call(BY, ProgramMethod::Halt).await.unwrap();
    let outcome = ended(&skill).await;
    assert!(!outcome.succeeded);
    until(&memory, 0, State::Stopped).await;
    assert_eq!(memory.commands(), ["Start", "Pause", "Resume", "Stop"]);
}

#[tokio::test]
async fn modules_of_the_field_are_run_as_well() {
    let faults = [
        PeaFaults {
            keeps_command: true,
            ..PeaFaults::default()
        },
        PeaFaults {
            enables_late: true,
            ..PeaFaults::default()
        },
        PeaFaults {
            resetting_word: Some(32678),
            ..PeaFaults::default()
        },
    ];
    for fault in faults {
        let (skill, _memory) = skill("Solo-Polka", fault.clone(), patient());
        for _ in 0..2 {
            start(&skill, &[]).await;
            let outcome = ended(&skill).await;
            assert!(outcome.succeeded, "{fault:?}: {}", outcome.message);
        }
    }
}

#[tokio::test]
async fn each_wait_ends_and_names_what_is_missing() {
    let cases = [
        (
            PeaFaults {
                stays_in_operator_mode: true,
                ..PeaFaults::default()
            },
            "automatic mode (StateAutAct) was not confirmed within 200ms",
        ),
        (
            PeaFaults {
                ignores_procedure: true,
                ..PeaFaults::default()
            },
            "procedure 3 (ProcedureReq) was not confirmed within 200ms",
        ),
    ];
    for (faults, expected) in cases {
        let (skill, memory) = skill("Solo-Polka", faults, short());
        start(&skill, &[]).await;
        let outcome = ended(&skill).await;
        assert!(outcome.message.contains(expected), "{}", outcome.message);
        assert!(memory.commands().is_empty(), "no command was written");
    }
}

#[tokio::test]
async fn a_service_that_runs_is_not_started_again() {
    let (skill, memory) = skill("Duet-Waltz", PeaFaults::default(), patient());
    start(&skill, &[]).await;
    until(&memory, 0, State::Execute).await;
    let module = stage();
    let nodes = Arc::<Memory>::clone(&memory);
    let settings = ModuleSettings {
        module,
        endpoint: None,
        capabilities: std::collections::BTreeMap::new(),
        configuration: false,
        timing: patient(),
    };
    let other = ProcessModule::over(settings, nodes);
    let second = other.spawn(&other.skills[0], Vec::new()).unwrap();
    start(&second, &[]).await;
    let outcome = ended(&second).await;
    assert!(
        outcome
            .message
            .contains("the service Duet is Execute, so it cannot be started"),
        "{}",
        outcome.message
    );
    assert_eq!(memory.commands(), ["Start"]);
}

#[tokio::test]
async fn the_end_of_a_silent_module_is_unknown() {
    let (skill, memory) = skill("Duet-Waltz", PeaFaults::default(), patient());
    start(&skill, &[]).await;
    until(&memory, 0, State::Execute).await;
    memory
        .is_silent
        .store(true, std::sync::atomic::Ordering::SeqCst);
    let outcome = ended(&skill).await;
    assert!(
        outcome
            .message
            .contains("no answer for 300ms, so the end is unknown"),
        "{}",
        outcome.message
    );
}
