//! Calls: services, actions, and Methods of other servers.
use std::path::PathBuf;
use std::time::Duration;

use mappings::{
    Assigned, Assignment, Call, CallKind, Checked, Code, ExecutedBy, Mapping, OpenTypeFiles,
    PathFault, SpaceId, Surroundings, TopicId,
};
use messages::{DefinitionText, DefinitionTexts, Dialect, Language, Literal, TextKind, TypeName};

const HEAD: &str = "spaces: [{id: 1}, {id: 2}]\nnamespaces: {2: 'urn:my-plant:line'}\ncalls:\n";

/// An action of ROS 2 with its definition in a file.
struct Files;

impl DefinitionTexts for Files {
    fn find(
        &mut self,
        dialect: Dialect,
        kind: TextKind,
        name: &TypeName,
    ) -> Option<DefinitionText> {
        let known = dialect == Dialect::Ros2 && kind == TextKind::Action;
        (known && name.to_string() == "nav2_msgs/NavigateToPose").then(|| DefinitionText {
            text: "geometry_msgs/PoseStamped pose\nstring behavior_tree\n---\nstd_msgs/Empty result\n---\n\
                   geometry_msgs/PoseStamped current_pose\nbuiltin_interfaces/Duration navigation_time\n\
                   builtin_interfaces/Duration estimated_time_remaining\nint16 number_of_recoveries\n\
                   float32 distance_remaining\n"
                .to_owned(),
            language: Language::Ros,
            file: "nav2_msgs/action/NavigateToPose.action".into(),
        })
    }

    fn names(&mut self, _: Dialect, _: TextKind) -> Vec<TypeName> {
        Vec::new()
    }

    fn places(&self, _: Dialect) -> Vec<String> {
        Vec::new()
    }
}

impl OpenTypeFiles for Files {
    fn faults(&mut self) -> Vec<PathFault> {
        Vec::new()
    }
}

struct Beside;

impl Surroundings for Beside {
    fn read(&self, _: &str) -> std::io::Result<String> {
        Err(std::io::Error::other("there is no file"))
    }

    fn list(&self, _: &str) -> std::io::Result<Vec<String>> {
        Ok(Vec::new())
    }

    fn variable(&self, _: &str) -> Option<String> {
        None
    }

    fn types(&self, _: &[PathBuf]) -> Box<dyn OpenTypeFiles> {
        Box::new(Files)
    }
}

fn check(calls: &str) -> Checked {
    Mapping::from_text(&format!("{HEAD}{calls}"), "cell.yaml", &Beside)
}

fn only(checked: &Checked) -> &Call {
    assert!(checked.findings.is_empty(), "{}", checked.render_all());
    let [call] = checked.mapping.as_ref().unwrap().calls() else {
        panic!("not one call");
    };
    call
}

fn field(target: &str, path: &str) -> Assignment {
    Assignment {
        target: target.to_owned(),
        value: Assigned::Field(path.to_owned()),
    }
}

#[test]
fn an_action_takes_five_topics_and_its_maps_are_of_its_calls() {
    let checked = check(
        "  - node: ns=2;i=70
    name: Drive
    origin: 2
    ros:
      - {action: /navigate_to_pose, type: nav2_msgs/action/NavigateToPose}
      - space: 1
        action: /move_base
        type: move_base_msgs/MoveBase
        goal: {pose: {field: target_pose}, behavior_tree: ''}
        feedback: {base_position: {field: current_pose}}
        result: {}
",
    );
    let call = only(&checked);
    assert_eq!(call.kind, CallKind::Action);
    let ExecutedBy::Ros(target) = &call.executed else {
        panic!("{:?}", call.executed);
    };
    assert_eq!(target.name, "/navigate_to_pose");
    assert_eq!(target.type_name.to_string(), "nav2_msgs/NavigateToPose");
    let topics: Vec<String> = call.topics().map(|topic| topic.to_string()).collect();
    let expected = ["70", "71", "72", "73", "74"].map(|id| format!("ua_2_2_{id}"));
    assert_eq!(topics, expected);
    let asked = call.binding(SpaceId::ROS1).unwrap();
    assert_eq!(asked.target.name, "/move_base");
    let constant = Assignment {
        target: "goal.behavior_tree".to_owned(),
        value: Assigned::Constant(Literal::One(String::new())),
    };
    assert_eq!(
        asked.request.0,
        [field("goal.pose", "goal.target_pose"), constant]
    );
    let feedback = field("feedback.base_position", "feedback.current_pose");
    assert_eq!(asked.feedback.0, [feedback]);
    assert!(asked.response.is_empty());
    let kinds: Vec<TextKind> = checked.types.iter().map(|used| used.kind).collect();
    assert_eq!(kinds, [TextKind::Action, TextKind::Action]);
}

#[test]
fn what_a_goal_or_feedback_is_made_of_is_told_by_the_names_of_the_mapping() {
    let drive = |maps: &str| {
        let checked = check(&format!(
            "  - {{node: ns=2;i=70, name: Drive, origin: 2, ros: [{{action: /nav, type: nav2_msgs/NavigateToPose}},\n    \
             {{space: 1, action: /move_base, type: move_base_msgs/MoveBase, {maps}}}]}}\n"
        ));
        let told = checked.findings.iter();
        told.map(|found| (found.code, found.message.clone()))
            .collect::<Vec<_>>()
    };
    for (maps, fault) in [
        (
            "feedback: {base_position: {field: current_pose}}",
            "cannot make the goal of `nav2_msgs/NavigateToPose` from the goal of `move_base_msgs/MoveBase`: \
             `pose.header.stamp` (DateTime) has no source",
        ),
        (
            "goal: {pose: {field: target_pose}, behaviour_tree: ''}, feedback: {base_position: {field: current_pose}}",
            "the goal of `nav2_msgs/NavigateToPose` has no field `behaviour_tree`",
        ),
        (
            "goal: {pose: {field: target_pose}, behavior_tree: ''}",
            "cannot make the feedback of `move_base_msgs/MoveBase` from the feedback of `nav2_msgs/NavigateToPose`: \
             `base_position.header.stamp` (DateTime) has no source",
        ),
    ] {
        assert_eq!(drive(maps), [(Code::CallMap, fault.to_owned())]);
    }
}

#[test]
fn a_method_of_another_server_is_asked_for_by_services() {
    let checked = check(
        "  - node: ns=2;i=80
    name: Plc.Reset
    origin: 0
    opcua: {endpoint: 'opc.tcp://127.0.0.1:4841', object: 'nsu=urn:plc;s=Line', method: 'ns=3;s=Line.Reset'}
    ros: {space: 1, service: /plc/reset, type: std_srvs/Trigger}
    timeout: 5s
",
    );
    let call = only(&checked);
    let ExecutedBy::OpcUa(method) = &call.executed else {
        panic!("{:?}", call.executed);
    };
    assert_eq!(
        method.access.endpoint.to_string(),
        "opc.tcp://127.0.0.1:4841"
    );
    assert_eq!(method.object.to_string(), "nsu=urn:plc;s=Line");
    assert_eq!(method.method.to_string(), "ns=3;s=Line.Reset");
    assert_eq!(call.kind, CallKind::Service);
    assert_eq!(call.timeout, Duration::from_secs(5));
    let mapping = checked.mapping.as_ref().unwrap();
    assert_eq!(mapping.executed_in(SpaceId::UA).count(), 1);
    assert_eq!(mapping.asked_in(SpaceId::ROS1).count(), 1);
}

#[test]
fn the_server_acknowledges_alarms_for_services() {
    let checked = check(
        "  - node: ns=2;i=80
    name: Alarms.Acknowledge
    origin: 0
    acknowledges: alarms
    ros:
      - {space: 1, service: /acknowledge, type: ua_msgs/AcknowledgeAlarm}
      - {space: 2, service: /acknowledge, type: ua_msgs/AcknowledgeAlarm}
",
    );
    let call = only(&checked);
    assert_eq!(call.executed, ExecutedBy::Acknowledging);
    assert_eq!(call.asked.len(), 2);
    let elsewhere = [
        "origin: 1, ros: {service: /a, type: ua_msgs/AcknowledgeAlarm}",
        "origin: 0, opcua: {endpoint: 'opc.tcp://127.0.0.1:4841', object: 'ns=2;i=1', method: 'ns=2;i=2'}",
        "origin: 0, ros: {space: 1, action: /a, type: actionlib/Test}",
    ];
    for keys in elsewhere {
        let call =
            format!("  - {{node: ns=2;i=80, name: Acknowledge, {keys}, acknowledges: alarms}}");
        let checked = check(&call);
        let codes: Vec<Code> = checked.findings.iter().map(|one| one.code).collect();
        assert!(
            codes.contains(&Code::Alarm),
            "{keys}: {}",
            checked.render_all()
        );
        assert!(checked.mapping.is_none(), "{keys}");
    }
}

#[test]
fn a_constant_is_a_value_of_its_field_whoever_executes() {
    let told = |call: &str| {
        let checked = check(call);
        let found = checked.findings.iter();
        found.map(|one| one.message.clone()).collect::<Vec<_>>()
    };
    let asked = |maps: &str| {
        told(&format!(
            "  - {{node: ns=2;i=61, name: Switch, origin: 1, ros: [{{service: /a, type: std_srvs/SetBool}},\n    \
             {{space: 2, service: /b, type: std_srvs/Trigger, request: {{data: {maps}}}]}}\n"
        ))
    };
    assert!(asked("true}").is_empty());
    assert_eq!(
        asked("on}"),
        ["in the request of `std_srvs/SetBool`, `data` is Boolean, but its constant is not"]
    );
    let fault = asked("true}, response: {success: maybe}");
    assert!(
        matches!(&fault[..], [one] if one.starts_with("in the response of `std_srvs/Trigger`, ")),
        "{fault:?}"
    );
    // Of a component only the assigned response is known.
    assert_eq!(
        told(
            "  - {node: ns=2;i=61, name: Grasp, origin: 0, ros: {space: 2, service: /b, type: std_srvs/Trigger, \
             response: {done: true}}}\n"
        ),
        ["the response of `std_srvs/Trigger` has no field `done`"]
    );
}

#[test]
fn a_skill_of_a_component_is_asked_for_as_an_action() {
    let checked = check(
        "  - {node: ns=2;i=110, name: Gripper.Grasp, origin: 0, ros: {space: 2, action: /grasp, type: ua_msgs/Skill}}\n",
    );
    assert_eq!(
        checked.findings.iter().map(|f| f.code).collect::<Vec<_>>(),
        [Code::UnknownActionType]
    );
    let mapping = checked.mapping.as_ref().unwrap();
    let call = mapping
        .call("ua_0_2_110".parse::<TopicId>().unwrap())
        .unwrap();
    assert_eq!(
        (call.kind, &call.executed),
        (CallKind::Action, &ExecutedBy::Elsewhere)
    );
}

#[test]
fn another_method_or_map_of_an_action_is_a_difference() {
    let one = |text: &str| check(text).mapping.unwrap();
    let method = |name: &str| {
        format!(
            "  - {{node: ns=2;i=80, name: Reset, origin: 0, opcua: {{endpoint: 'opc.tcp://plc', object: i=85, method: 's={name}'}}}}\n"
        )
    };
    let difference = one(&method("A")).difference(&one(&method("B")));
    assert_eq!((difference.changed.len(), difference.same), (1, 0));
    let action = |kind: &str| {
        format!(
            "  - {{node: ns=2;i=70, name: Drive, origin: 2, ros: {{{kind}: /nav, type: nav2_msgs/NavigateToPose}}}}\n"
        )
    };
    let difference = one(&action("action")).difference(&one(&action("service")));
    assert_eq!((difference.changed.len(), difference.same), (1, 0));
}

#[test]
fn a_topic_of_a_pattern_does_not_take_the_numbers_of_an_action() {
    let text = format!(
        "{HEAD}  - {{node: ns=2;i=70, name: Drive, origin: 1, ros: {{action: /drive, type: move_base_msgs/MoveBase}}}}\n\
         patterns: [{{topics: /robot*/pose, origin: 1, node: 'ns=2;i={{1}}', name: 'Robot{{1}}'}}]\n"
    );
    let mapping = Mapping::from_text(&text, "cell.yaml", &Beside)
        .mapping
        .unwrap();
    let of = |topic: &str| mapping.matching(SpaceId::ROS1, topic, None).unwrap();
    assert!(of("/robot75/pose").is_ok());
    let fault = of("/robot73/pose").unwrap_err().to_string();
    assert!(fault.contains("Drive"), "{fault}");
}
