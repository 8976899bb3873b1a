//! Every kind of executor called by every kind of caller, with requests and responses of every
//! kind.
//!
//! The tables of `docs/calls.md` hold the results of these tests.

mod actions;

use serde_json::{Value, json};
use system_tests::{
    CallerKind, CallerScript, Cell, Child, Distribution, Peer, StartedChild, program,
};

/// The letter of each case in the table of the page, and its name in `peers/calls/cases.py`.
const CASES: [(char, &str); 5] = [
    ('B', "bundled"),
    ('F', "files"),
    ('E', "empty"),
    ('L', "megabyte"),
    ('M', "messages"),
];
/// Number of calls of each caller, for each case of each executor.
const COUNT: u64 = 2;
const ASKING: [CallerKind; 8] = [
    CallerKind::Rospy,
    CallerKind::Roscpp,
    CallerKind::Rclpy(Distribution::Jazzy, 3),
    CallerKind::Rclpy(Distribution::Kilted, 3),
    CallerKind::Cyclone(3),
    CallerKind::Asyncua,
    CallerKind::NodeOpcua,
    CallerKind::UaSpace,
];
const PLC: &str = "opc.tcp://127.0.0.1:4841";

const METHOD: &str = "Method (asyncua)";
const SKILL: &str = "skill of a component";

/// A call with all its names.
struct Call {
    letter: char,
    /// The case in `peers/calls/cases.py`.
    case: &'static str,
    service: String,
    method: String,
    topic: String,
}

/// An executor and its calls.
struct Executing {
    name: &'static str,
    space: u16,
    calls: Vec<Call>,
}

impl Executing {
    /// Services of ROS with the numbers from `first` on, without a mapping.
    fn services(name: &'static str, space: u16, first: usize) -> Self {
        let calls = CASES.iter().zip(first..).map(|((letter, case), number)| {
            let topic = format!("ua_{space}_2_{number}");
            Call {
                letter: *letter,
                case,
                service: format!("/{topic}"),
                method: format!("UaSpace/Calls/{topic}"),
                topic,
            }
        });
        Self {
            name,
            space,
            calls: calls.collect(),
        }
    }

    /// Methods of another server. For the case of a type from files, the mapping sets the ROS type.
    fn methods() -> Self {
        let mut methods = Self::services(METHOD, 0, 60);
        methods.calls.pop();
        for (call, number) in methods.calls.iter_mut().zip(60..) {
            call.topic = format!("ua_0_3_{number}");
            call.service = match call.case {
                "files" => "/plc/files".to_owned(),
                _ => format!("/ua_0_3_{number}"),
            };
            call.method = format!("UaSpace/Calls/Plc/{}", call.case);
        }
        methods
    }

    /// Methods of a skill, which is Halted at first. Each caller resets it, starts it, and halts
    /// it.
    fn skill() -> Self {
        let call = |letter, case, service: &str, method: &str, number| Call {
            letter,
            case,
            service: service.to_owned(),
            method: format!("UaSpace/Calls/parallel-gripper/Grasp/{method}"),
            topic: format!("ua_0_7_{number}"),
        };
        Self {
            name: SKILL,
            space: 0,
            calls: vec![
                call('B', "skill", "/ua_0_7_109", "Reset", 109),
                call('F', "grasp", "/grasp", "Start", 105),
                call('E', "skill", "/ua_0_7_106", "Halt", 106),
            ],
        }
    }

    /// Returns the number of calls per caller and case: a call that changes the state of a skill is
    /// made once.
    fn count(&self) -> u64 {
        if self.name == SKILL { 1 } else { COUNT }
    }

    /// Returns the arguments of the executor's peers.
    fn words(&self) -> Vec<String> {
        let calls = self.calls.iter();
        calls
            .map(|call| format!("{}={}", call.case, call.service))
            .collect()
    }
}

/// Returns whether a caller needs neither a bridge nor the server: nodes of the same ROS, and OPC
/// UA clients of a server's Methods.
fn is_at_home(asking: CallerKind, executing: &Executing) -> bool {
    match asking {
        CallerKind::Rospy | CallerKind::Roscpp => executing.space == 1,
        CallerKind::Asyncua | CallerKind::NodeOpcua => executing.name == METHOD,
        CallerKind::Rclpy(..) | CallerKind::Cyclone(_) | CallerKind::UaSpace => false,
    }
}

/// Returns a mapping of the Methods of the other server, with a name and a type in ROS where the
/// call needs them.
fn methods() -> String {
    let node = "nsu=urn:ua-bridge:system-tests:plc;s=Line";
    let methods = Executing::methods();
    let methods = methods.calls.iter().zip(60..).map(|(call, number)| {
        let case = call.case;
        let ros = "type: test_msgs/BasicTypes";
        let ros = match case {
            "files" => format!(
                ", ros: [{{space: 1, service: /plc/files, {ros}}}, {{space: 3, service: /plc/files, {ros}}}]"
            ),
            _ => String::new(),
        };
        format!(
            "  - {{node: ns=3;i={number}, name: Plc.{case}, origin: 0, \
             opcua: {{endpoint: '{PLC}', object: '{node}', method: '{node}.{case}'}}{ros}}}\n"
        )
    });
    format!(
        "namespaces: {{3: 'urn:test:plc-calls', 7: 'urn:test:gripper'}}\ncalls:\n{}",
        methods.collect::<String>()
    )
}

/// Returns a mapping of the Start of a skill to a ROS type that is unrelated to it.
fn start() -> String {
    let zeros = [
        "byte", "char", "float32", "float64", "int8", "uint8", "int16", "uint16", "int32",
        "uint32", "int64", "uint64",
    ];
    let zeros = zeros.map(|name| format!("{name}_value: 0")).join(", ");
    let grasp = format!(
        "service: /grasp, type: test_msgs/BasicTypes, request: {{Force: {{field: float64_value}}}}, \
         response: {{bool_value: {{field: success}}, string_value: {{field: message}}, {zeros}}}"
    );
    format!(
        "  - {{node: ns=7;i=105, name: parallel-gripper.Grasp.Start, origin: 0, \
         ros: [{{space: 1, {grasp}}}, {{space: 3, {grasp}}}]}}\n"
    )
}

fn mapping(cell: &Cell, name: &str, space: u16, calls: &str) -> String {
    let types = cell.call_types(space);
    let yaml = format!(
        "spaces: [{{id: 1}}, {{id: 2, domain: 2}}, {{id: 3, domain: 3}}]\ntype_paths: [{types}]\n{calls}"
    );
    let file = cell.file(name, &yaml);
    file.to_str().unwrap().to_owned()
}

/// Starts a component. The Methods of its skill need no other executor.
fn component(cell: &Cell) -> Child {
    let yaml = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../examples/plant/parallel-gripper.yaml"
    );
    StartedChild::new("ua-component", &program("ua-component"))
        .args([yaml, "--interface", "lo", "--lds", "none"])
        .args(["--pki".into(), cell.folder().join("pki-component")])
        .start()
}

/// Has all callers make a call at once. Returns for each caller whether every answer was right, or
/// `None` for a caller without a bridge.
fn asked(
    askers: &mut [(CallerKind, CallerScript)],
    executing: &Executing,
    call: &Call,
) -> Vec<Option<bool>> {
    let away = |asking: &CallerKind| !is_at_home(*asking, executing);
    for ((asking, asker), turn) in askers.iter_mut().zip(0..).filter(|((of, _), _)| away(of)) {
        let service = match asking {
            CallerKind::Asyncua | CallerKind::NodeOpcua => &call.method,
            CallerKind::UaSpace => &call.topic,
            CallerKind::Rospy
            | CallerKind::Roscpp
            | CallerKind::Rclpy(..)
            | CallerKind::Cyclone(_) => &call.service,
        };
        asker.begin(json!({
            "case": call.case, "service": service, "first": 10 * turn, "count": executing.count(),
            "wait": 20, "patience": 20,
        }));
    }
    let told = askers.iter_mut().map(|(asking, asker)| {
        away(asking).then(|| {
            let told = asker.told();
            let right = told["right"] == executing.count();
            if !right {
                let (case, asking) = (call.case, asking.name());
                eprintln!("{case} of {} asked by {asking}: {told}", executing.name);
            }
            right
        })
    });
    told.collect()
}

/// Returns the row of the table for the observed results, with a word for each caller.
fn row(askers: &mut [(CallerKind, CallerScript)], executing: &Executing) -> Vec<String> {
    let mut cells = vec![executing.name.to_owned()];
    cells.extend(askers.iter().map(|_| String::new()));
    // Callers of a skill take turns: the skill refuses calls that its state does not allow, or
    // while another caller has the lease.
    let together = if executing.name == SKILL {
        1
    } else {
        askers.len()
    };
    for (askers, cells) in askers
        .chunks_mut(together)
        .zip(cells[1..].chunks_mut(together))
    {
        for call in &executing.calls {
            for (cell, right) in cells.iter_mut().zip(asked(askers, executing, call)) {
                match right {
                    Some(true) => cell.push(call.letter),
                    Some(false) => {}
                    None => *cell = "direct".to_owned(),
                }
            }
        }
    }
    cells
}

/// Returns the rows of the table of `docs/calls.md` with the given head.
fn rows_of_page(head: &[String]) -> Vec<Vec<String>> {
    let cells = |line: &str| -> Vec<String> {
        let cells = line.trim().trim_matches('|').split('|');
        cells.map(|cell| cell.trim().to_owned()).collect()
    };
    let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/calls.md");
    let page = std::fs::read_to_string(page).unwrap();
    let mut lines = page.lines();
    lines
        .find(|line| line.starts_with('|') && cells(line) == head)
        .unwrap_or_else(|| panic!("docs/calls.md has no table with the head {head:?}"));
    let rows = lines.skip(1).take_while(|line| line.starts_with('|'));
    rows.map(cells).collect()
}

#[test]
fn all_who_execute_are_asked_by_all_who_ask() {
    let Some(cell) = Cell::with(&[
        Peer::Ros1,
        Peer::Roscpp,
        Peer::Ros2,
        Peer::Python,
        Peer::NodeOpcua,
    ]) else {
        return;
    };
    let _core = cell.roscore();
    let all = [
        Executing::services("rospy", 1, 60),
        Executing::services("roscpp", 1, 65),
        Executing::services("rclpy (Jazzy)", 2, 60),
        Executing::services("rclpy (Kilted)", 2, 65),
        Executing::services("Cyclone DDS", 2, 70),
        Executing::methods(),
        Executing::skill(),
    ];
    let [rospy, roscpp, jazzy, kilted, cyclone] = [0, 1, 2, 3, 4].map(|of: usize| all[of].words());
    let cases = all[5].calls.iter().map(|call| call.case);
    let mut executors = cell.executors([
        cell.rospy_started("calls/ros1_executor.py", &[])
            .args(rospy),
        cell.roscpp_started(&["serve"]).args(roscpp),
        cell.rclpy_started(Distribution::Jazzy, "calls/ros2_executor.py", &[])
            .args(jazzy),
        cell.rclpy_started(Distribution::Kilted, "calls/ros2_executor.py", &[])
            .args(kilted),
        cell.cyclone_started("calls/cyclone.py", &["serve", "--domain", "2"])
            .args(cyclone),
        cell.asyncua_started("calls/opcua_executor.py", &[PLC])
            .args(cases),
    ]);
    let _component = component(&cell);
    let calls = [methods(), start()].concat();
    let one = mapping(&cell, "one.yaml", 1, &calls);
    let two = mapping(&cell, "two.yaml", 2, &calls);
    // A mapping that names a namespace of space 0 makes ua-server treat it as its own.
    let zero = methods().replace(", 7: 'urn:test:gripper'", "");
    let zero = mapping(&cell, "zero.yaml", 2, &zero);
    let _programs = (
        cell.bridge_ros1(&[&one]),
        cell.bridge_ros2_alone(&[&two, "--space", "2,3"]).start(),
        cell.ua_server(&[&zero]),
    );
    let mut askers: Vec<_> = ASKING.into_iter().zip(cell.askers(&ASKING)).collect();
    let mut head = vec!["executed by".to_owned()];
    head.extend(ASKING.map(|asking| asking.name().to_owned()));
    let seen: Vec<Vec<String>> = all.iter().map(|of| row(&mut askers, of)).collect();
    let table: String = seen
        .iter()
        .map(|row| format!("| {} |\n", row.join(" | ")))
        .collect();
    assert_eq!(
        seen,
        rows_of_page(&head),
        "seen:\n| {} |\n{table}",
        head.join(" | ")
    );
    // Each answered call was executed once.
    for (executor, row) in executors.iter_mut().zip(&seen) {
        let calls = row[1..].iter().filter(|cell| *cell != "direct");
        let calls = calls.map(|cell| cell.len() as u64 * COUNT).sum::<u64>();
        let counts: Value = executor.counts();
        assert_eq!(counts["executed"], calls, "{}: {counts}", row[0]);
    }
}
