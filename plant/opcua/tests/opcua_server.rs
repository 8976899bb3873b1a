//! Tests of servers with NodeSets, with clients over loopback.

#![expect(clippy::unwrap_used, clippy::panic, reason = "test code")]

mod cell;

use std::time::Duration;

use cell::{MACHINES, OpcuaCell, PATIENCE, VENDOR, next_event, next_value, press};
use opcua::types::{
    AttributeId, DataValue, LocalizedText, MethodId, NodeId, ObjectId, ObjectTypeId, QualifiedName,
    ReferenceTypeId, StatusCode, Variant,
};
use plant_opcua::client::{Browse, CallError, MonitoredWatch, Notice, Select};
use plant_opcua::nodeset::NodeSetError;
use plant_opcua::server::{
    InstanceError, InstanceSpec, MethodRefusal, MethodRequest, OpcUaServer, ServerBuilder,
    ServerConfig, ServerError, StateRef, TransitionEvent, WriteRequest, method, write,
};

#[tokio::test]
async fn an_instance_has_what_its_types_make_mandatory() {
    let cell = OpcuaCell::new();
    let press = press(&cell.server, 100, &["Remark", "ProgramDiagnostic"]);
    let paths: Vec<&str> = press.nodes().map(|(path, _)| path).collect();
    for path in [
        // Children of the core namespace, two supertypes above.
        "CurrentState",
        "CurrentState/Id",
        "CurrentState/Number",
        "LastTransition/TransitionTime",
        "Deletable",
        // Optional children of the supertype that the test selects.
        "ProgramDiagnostic/LastMethodCall",
        "Remark",
        // Placeholders of the supertype that a subtype makes mandatory.
        "Start",
        "Halt",
        "Turn/InputArguments",
        // An object with children of two types.
        "ParameterSet/Force",
        "ParameterSet/Depth",
        // A child of an interface.
        "SerialNumber",
    ] {
        assert!(paths.contains(&path), "{path} is missing in {paths:?}");
    }
    for path in ["Suspend", "FinalResultData", "Ready", "AvailableStates"] {
        assert!(!paths.contains(&path), "nobody asked for {path}");
    }

    // Clients see the same nodes.
    let client = cell.client().await;
    let machines = client.namespace(MACHINES).unwrap();
    let force = [
        QualifiedName::new(machines, "ParameterSet"),
        QualifiedName::new(machines, "Force"),
    ];
    let force = client.translate(&press.node_id, &force).await.unwrap();
    assert_eq!(Some(&force), press.node("ParameterSet/Force"));
    let read = client.read(&[force]).await.unwrap();
    assert_eq!(read[0].value, Some(Variant::Double(12.5)));
    let up = Browse::of(ReferenceTypeId::HasTypeDefinition);
    let types = client.browse(&press.node_id, up).await.unwrap();
    let press_type = &types[0].node_id.node_id;
    assert_eq!(types[0].browse_name.name.as_ref(), "PressType");
    let program: NodeId = ObjectTypeId::ProgramStateMachineType.into();
    assert!(client.is_subtype_of(press_type, &program).await.unwrap());
    assert!(!client.is_subtype_of(&program, press_type).await.unwrap());
    let below = client.subtypes(&program).await.unwrap();
    assert_eq!(below.first(), Some(&program));
    assert!(below.contains(press_type), "{below:?}");
    let state = press.node("CurrentState").unwrap();
    let variable_types = client
        .browse(state, Browse::of(ReferenceTypeId::HasTypeDefinition))
        .await;
    let variable_type = variable_types.unwrap().remove(0).node_id.node_id;
    assert_eq!(
        variable_type,
        NodeId::new(0, 2760),
        "FiniteStateVariableType"
    );
    // Before the first value, the variable has a Bad status.
    let read = client.read(std::slice::from_ref(state)).await.unwrap();
    assert_eq!(
        read[0].status,
        Some(StatusCode::BadWaitingForInitialData),
        "{read:?}"
    );
}

#[tokio::test]
async fn types_and_nodes_that_cannot_be_are_refused_and_nothing_is_made() {
    let cell = OpcuaCell::new();
    let server = &cell.server;
    let machine = server.find_type(MACHINES, "MachineType").unwrap();
    let press_type = server.find_type(VENDOR, "PressType").unwrap();
    let objects: NodeId = ObjectId::ObjectsFolder.into();
    let spec = |type_id: &NodeId, id: NodeId| {
        InstanceSpec::new(
            type_id.clone(),
            id,
            QualifiedName::new(1, "X"),
            objects.clone(),
        )
    };
    let mut next = 5000;
    let mut ids = |_: &str| {
        next += 1;
        NodeId::new(1, next)
    };
    let mut make = |spec: &InstanceSpec| server.instantiate(spec, &mut ids).unwrap_err();
    assert_eq!(
        make(&spec(&machine, NodeId::new(1, 1))),
        InstanceError::Abstract(machine.clone())
    );
    let foreign = NodeId::new(0, 1);
    assert_eq!(
        make(&spec(&press_type, foreign.clone())),
        InstanceError::Foreign(foreign)
    );
    let unknown = InstanceSpec {
        optional: vec!["Colour".to_owned()],
        ..spec(&press_type, NodeId::new(1, 1))
    };
    assert_eq!(
        make(&unknown),
        InstanceError::NoOptional("Colour".to_owned())
    );
    let orphan = InstanceSpec {
        parent: NodeId::new(1, 77),
        ..spec(&press_type, NodeId::new(1, 1))
    };
    assert_eq!(make(&orphan), InstanceError::NoParent(NodeId::new(1, 77)));
    // Two children with the same NodeId.
    let twice = server.instantiate(&spec(&press_type, NodeId::new(1, 1)), &mut |_| {
        NodeId::new(1, 2)
    });
    assert_eq!(twice.unwrap_err(), InstanceError::Taken(NodeId::new(1, 2)));
    assert_eq!(server.value(&NodeId::new(1, 2)), None);
    assert!(
        !server
            .children(&objects)
            .iter()
            .any(|child| child.node_id == NodeId::new(1, 1))
    );
}

#[tokio::test]
async fn a_method_is_reached_by_its_own_id_and_by_those_of_its_types() {
    let cell = OpcuaCell::new();
    let press = press(&cell.server, 100, &[]);
    let (tell, mut called) = tokio::sync::mpsc::channel(8);
    let start = press.node("Start").unwrap();
    cell.server.on_call(
        &press.node_id,
        start,
        method(move |request: MethodRequest| {
            tell.try_send(request).unwrap();
            Ok(vec![])
        }),
    );
    let client = cell.client().await;
    let machines = client.namespace(MACHINES).unwrap();
    let ids = [
        start.clone(),
        NodeId::new(machines, 1001),
        MethodId::ProgramStateMachineType_Start.into(),
    ];
    let mut sessions = Vec::new();
    for id in &ids {
        client.call(&press.node_id, id, vec![]).await.unwrap();
        let request = called.recv().await.unwrap();
        assert_eq!(
            (&request.method, request.name.as_str()),
            (start, "Start"),
            "by {id}"
        );
        assert_eq!(request.object, press.node_id);
        assert_eq!(request.caller.user, "anonymous");
        assert_eq!(request.caller.application_uri, "urn:test:client");
        sessions.push(request.caller.session);
    }
    sessions.dedup();
    assert_eq!(sessions.len(), 1, "all in one session: {sessions:?}");
}

fn status(result: Result<Vec<Variant>, CallError>) -> StatusCode {
    match result {
        Err(CallError::Refused { status, .. }) => status,
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_method_of_one_object_is_none_of_another() {
    let cell = OpcuaCell::new();
    let press = press(&cell.server, 100, &[]);
    let other = cell::press(&cell.server, 300, &[]);
    let start = press.node("Start").unwrap();
    let invalid_state = || method(|_| Err(StatusCode::BadInvalidState.into()));
    cell.server.on_call(&press.node_id, start, invalid_state());
    let client = cell.client().await;
    let start_of_type: NodeId = MethodId::ProgramStateMachineType_Start.into();
    // Another object of the type has its own handler, or no handler.
    assert_eq!(
        status(client.call(&other.node_id, &start_of_type, vec![]).await),
        StatusCode::BadNotImplemented
    );
    // The type has the method, but the object does not.
    let suspend: NodeId = MethodId::ProgramStateMachineType_Suspend.into();
    assert_eq!(
        status(client.call(&press.node_id, &suspend, vec![]).await),
        StatusCode::BadMethodInvalid
    );
    // A method of an object cannot be called on another object.
    assert_eq!(
        status(client.call(&other.node_id, start, vec![]).await),
        StatusCode::BadMethodInvalid
    );
    let nobody = NodeId::new(1, 999_999);
    assert_eq!(
        status(client.call(&nobody, &start_of_type, vec![]).await),
        StatusCode::BadNodeIdUnknown
    );
    // The methods of the Server object still work.
    let server: NodeId = ObjectId::Server.into();
    let items: NodeId = MethodId::Server_GetMonitoredItems.into();
    assert_eq!(
        status(client.call(&server, &items, vec![Variant::UInt32(7)]).await),
        StatusCode::BadSessionIdInvalid,
        "it has no subscriptions"
    );
    // Executable is false, and the handler returns the reason.
    cell.server.set_executable(start, false).unwrap();
    let shown = client
        .read_attributes(&[(start.clone(), AttributeId::Executable)])
        .await
        .unwrap();
    assert_eq!(shown[0].value, Some(Variant::Boolean(false)));
    assert_eq!(
        status(client.call(&press.node_id, start, vec![]).await),
        StatusCode::BadInvalidState
    );
}

#[tokio::test]
async fn arguments_that_do_not_fit_never_reach_the_handler() {
    let cell = OpcuaCell::new();
    let press = press(&cell.server, 100, &[]);
    let turn = press.node("Turn").unwrap();
    cell.server.on_call(
        &press.node_id,
        turn,
        method(|request: MethodRequest| {
            if matches!(request.arguments[0], Variant::Double(angle) if angle > 90.0) {
                let each = vec![StatusCode::BadOutOfRange, StatusCode::Good];
                return Err(MethodRefusal::Arguments(each));
            }
            Ok(request.arguments)
        }),
    );
    let client = cell.client().await;
    let names = || Variant::from(vec!["a".to_owned(), "b".to_owned()]);
    let call = |arguments| client.call(&press.node_id, turn, arguments);
    assert_eq!(
        call(vec![Variant::Double(1.0), names()]).await.unwrap(),
        [Variant::Double(1.0), names()]
    );
    for (arguments, status, each) in [
        (vec![], StatusCode::BadArgumentsMissing, vec![]),
        (
            vec![Variant::Double(1.0), names(), names()],
            StatusCode::BadTooManyArguments,
            vec![],
        ),
        (
            vec![Variant::Float(1.0), names()],
            StatusCode::BadInvalidArgument,
            vec![StatusCode::BadTypeMismatch, StatusCode::Good],
        ),
        (
            vec![Variant::Double(1.0), Variant::from("a")],
            StatusCode::BadInvalidArgument,
            vec![StatusCode::Good, StatusCode::BadTypeMismatch],
        ),
        (
            vec![Variant::Empty, names()],
            StatusCode::BadInvalidArgument,
            vec![StatusCode::BadTypeMismatch, StatusCode::Good],
        ),
        // Refused by the handler.
        (
            vec![Variant::Double(91.0), names()],
            StatusCode::BadInvalidArgument,
            vec![StatusCode::BadOutOfRange, StatusCode::Good],
        ),
    ] {
        let given = format!("{arguments:?}");
        let refused = call(arguments).await.unwrap_err();
        let wanted = CallError::Refused {
            status,
            arguments: each,
        };
        assert_eq!(refused, wanted, "{given}");
    }
}

#[tokio::test]
async fn a_write_is_shown_unless_its_handler_refuses() {
    let cell = OpcuaCell::new();
    let press = press(&cell.server, 100, &[]);
    let force = press.node("ParameterSet/Force").unwrap().clone();
    let depth = press.node("ParameterSet/Depth").unwrap().clone();
    let state = press.node("CurrentState").unwrap().clone();
    cell.server.on_write(
        &force,
        write(|request: WriteRequest| match request.value.value {
            Some(Variant::Double(force)) if force <= 100.0 => Ok(()),
            _ => Err(StatusCode::BadOutOfRange),
        }),
    );
    let client = cell.client().await;
    let mut watched = client.subscribe(
        vec![MonitoredWatch::Value(force.clone())],
        Duration::from_millis(10),
        16,
    );
    assert_eq!(
        next_value(&mut watched).await,
        (0, Some(Variant::Double(12.5)))
    );
    let results = client
        .write(&[
            (force.clone(), Variant::Double(101.0)),
            (depth.clone(), Variant::Double(3.0)),
            (depth.clone(), Variant::from("deep")),
            (state, Variant::from("Ready")),
            (NodeId::new(1, 999_999), Variant::Double(1.0)),
            (force.clone(), Variant::Double(99.0)),
        ])
        .await
        .unwrap();
    assert_eq!(
        results,
        [
            StatusCode::BadOutOfRange,
            StatusCode::Good,
            StatusCode::BadTypeMismatch,
            StatusCode::BadNotWritable,
            StatusCode::BadNodeIdUnknown,
            StatusCode::Good,
        ]
    );
    assert_eq!(
        next_value(&mut watched).await,
        (0, Some(Variant::Double(99.0)))
    );
    cell.server.show(&depth, 3.5).unwrap();
    let read = client.read(std::slice::from_ref(&depth)).await.unwrap();
    assert_eq!(read[0].value, Some(Variant::Double(3.5)));
    assert!(read[0].server_timestamp.is_some(), "{read:?}");
    let picoseconds = (read[0].source_picoseconds, read[0].server_picoseconds);
    assert_eq!(picoseconds, (None, None), "asyncua reads them wrong");
    cell.server.set_writable(&depth, false).unwrap();
    let refused = client
        .write(&[(depth, Variant::Double(4.0))])
        .await
        .unwrap();
    assert_eq!(refused, [StatusCode::BadNotWritable]);
}

fn transition(server: &OpcUaServer, source: &NodeId) -> TransitionEvent {
    let state = |name: &str, id: ObjectId, number| StateRef {
        name: name.to_owned(),
        id: id.into(),
        number,
    };
    TransitionEvent {
        source: source.clone(),
        source_name: "Press".to_owned(),
        event_type: server
            .find_type(MACHINES, "MachineTransitionEventType")
            .unwrap(),
        message: "ReadyToRunning".to_owned(),
        severity: 200,
        from_state: state("Ready", ObjectId::ProgramStateMachineType_Ready, 12),
        to_state: state("Running", ObjectId::ProgramStateMachineType_Running, 13),
        transition: state(
            "ReadyToRunning",
            ObjectId::ProgramStateMachineType_ReadyToRunning,
            2,
        ),
        intermediate_result: Variant::Double(0.5),
        fields: vec![(
            QualifiedName::new(server.namespace(MACHINES).unwrap(), "Run"),
            Variant::UInt32(7),
        )],
        time: opcua::types::DateTime::now(),
    }
}

#[tokio::test]
async fn an_event_comes_on_its_source_and_on_the_server_with_the_fields_of_each_type() {
    let cell = OpcuaCell::new();
    let press = press(&cell.server, 100, &[]);
    let client = cell.client().await;
    let declared = cell
        .server
        .find_type(MACHINES, "MachineTransitionEventType")
        .unwrap();
    let run = Select {
        type_id: declared.clone(),
        path: vec![QualifiedName::new(declared.namespace, "Run")],
    };
    let select = vec![
        Select::new(ObjectTypeId::BaseEventType, "SourceNode"),
        Select::new(ObjectTypeId::BaseEventType, "Message"),
        Select::new(ObjectTypeId::TransitionEventType, "FromState"),
        Select::new(ObjectTypeId::TransitionEventType, "ToState/Id"),
        Select::new(ObjectTypeId::TransitionEventType, "ToState/Number"),
        Select::new(
            ObjectTypeId::ProgramTransitionEventType,
            "IntermediateResult",
        ),
        // Fields of a supertype can be selected by a subtype.
        Select::new(declared.clone(), "Transition/Id"),
        Select::new(ObjectTypeId::BaseEventType, "Transition/Name"),
        run,
        Select::new(declared.clone(), "EventType"),
    ];
    let events = |node: NodeId, of_type| MonitoredWatch::Events {
        node,
        select: select.clone(),
        of_type,
    };
    let server: NodeId = ObjectId::Server.into();
    let program: NodeId = ObjectTypeId::ProgramTransitionEventType.into();
    let audit: NodeId = ObjectTypeId::AuditEventType.into();
    let watches = vec![
        events(press.node_id.clone(), None),
        events(server.clone(), Some(program)),
        events(server, Some(audit)),
    ];
    let mut subscription = client.subscribe(watches, Duration::from_millis(10), 16);
    assert_eq!(subscription.next().await, Some(Notice::Subscribed));
    // The monitored items are created after the subscription, so earlier events are lost.
    let raise = transition(&cell.server, &press.node_id);
    let mut seen = [false; 2];
    while seen != [true; 2] {
        cell.server.raise(&raise);
        while let Some((watch, fields)) =
            next_event(&mut subscription, Duration::from_millis(200)).await
        {
            assert_ne!(watch, 2, "it is no audit event");
            seen[watch] = true;
            let wanted: Vec<Variant> = vec![
                press.node_id.clone().into(),
                LocalizedText::from("ReadyToRunning").into(),
                LocalizedText::from("Ready").into(),
                NodeId::from(ObjectId::ProgramStateMachineType_Running).into(),
                13_u32.into(),
                0.5.into(),
                NodeId::from(ObjectId::ProgramStateMachineType_ReadyToRunning).into(),
                QualifiedName::new(0, "ReadyToRunning").into(),
                7_u32.into(),
                declared.clone().into(),
            ];
            assert_eq!(fields, wanted, "by watch {watch}");
        }
    }
}

#[tokio::test]
async fn an_object_with_events_says_so_and_is_found_from_the_server() {
    let cell = OpcuaCell::new();
    let press = press(&cell.server, 100, &[]);
    let client = cell.client().await;
    let read = client
        .read_attributes(&[(press.node_id.clone(), AttributeId::EventNotifier)])
        .await
        .unwrap();
    assert_eq!(read[0].value, Some(Variant::Byte(1)));
    let notifiers = client
        .browse(
            &press.node_id,
            Browse::of(ReferenceTypeId::HasEventSource).inverse(),
        )
        .await
        .unwrap();
    assert_eq!(notifiers[0].node_id.node_id, NodeId::from(ObjectId::Server));
    let generated = client
        .browse(
            &cell.server.find_type(MACHINES, "MachineType").unwrap(),
            Browse::of(ReferenceTypeId::GeneratesEvent),
        )
        .await
        .unwrap();
    let declared = cell
        .server
        .find_type(MACHINES, "MachineTransitionEventType")
        .unwrap();
    assert_eq!(generated[0].node_id.node_id, declared);
}

#[tokio::test]
async fn sessions_that_called_are_told_when_they_are_closed() {
    let cell = OpcuaCell::new();
    let press = press(&cell.server, 100, &[]);
    let start = press.node("Start").unwrap();
    let (tell, mut callers) = tokio::sync::mpsc::channel(8);
    cell.server.on_call(
        &press.node_id,
        start,
        method(move |request: MethodRequest| {
            tell.try_send(request.caller.session).unwrap();
            Ok(vec![])
        }),
    );
    let (tell, mut closed) = tokio::sync::mpsc::channel(8);
    cell.server
        .on_session_closed(move |session| tell.try_send(session).unwrap());
    let silent = cell.client().await;
    let caller = cell.client().await;
    // A subscription outlives its session, and must not keep the session alive.
    let watches = vec![MonitoredWatch::Value(
        press.node("CurrentState").unwrap().clone(),
    )];
    let mut subscription = caller.subscribe(watches, Duration::from_millis(10), 4);
    assert_eq!(subscription.next().await, Some(Notice::Subscribed));
    caller.call(&press.node_id, start, vec![]).await.unwrap();
    let session = callers.recv().await.unwrap();
    assert!(closed.try_recv().is_err());
    caller.close().await;
    let told = tokio::time::timeout(PATIENCE, closed.recv()).await.unwrap();
    assert_eq!(told, Some(session));
    silent.close().await;
    assert!(
        closed.try_recv().is_err(),
        "one that never called is nobody's"
    );
}

#[tokio::test]
async fn more_items_than_other_clients_can_bear_are_all_told() {
    let cell = OpcuaCell::new();
    let folder: NodeId = ObjectId::ObjectsFolder.into();
    let nodes: Vec<NodeId> = (0..3_000).map(|n| NodeId::new(1, 10_000 + n)).collect();
    for (n, node) in nodes.iter().enumerate() {
        cell.server
            .add_variable(&cell::variable(node, &folder, n))
            .unwrap();
    }
    let client = cell.client().await;
    let watches = nodes.iter().cloned().map(MonitoredWatch::Value).collect();
    let mut subscription = client.subscribe(watches, Duration::from_millis(50), 10_000);
    for round in 0..2_u32 {
        let mut missing = nodes.len();
        while missing > 0 {
            let (_, value) = next_value(&mut subscription).await;
            assert!(matches!(value, Some(Variant::UInt32(_))));
            missing -= 1;
        }
        if round == 0 {
            let values = nodes
                .iter()
                .map(|node| (node.clone(), DataValue::new_now(9_999_u32)));
            cell.server.show_all(values.collect()).unwrap();
        }
    }
    assert_eq!(subscription.dropped(), 0);
}

#[tokio::test]
async fn nodesets_are_loaded_in_the_order_they_need_and_refused_with_the_reason() {
    let build = |sets: &[(&str, String)]| {
        let config = ServerConfig::new("urn:a", "a", "opc.tcp://127.0.0.1:0".parse().unwrap());
        let builder = sets
            .iter()
            .fold(ServerBuilder::new(config), |builder, (name, xml)| {
                builder.nodeset_str(name, xml)
            });
        builder.build()
    };
    let machines = include_str!("data/machines.xml").to_owned();
    let vendor = include_str!("data/vendor.xml").to_owned();
    let server = build(&[("vendor", vendor.clone()), ("machines", machines.clone())]).unwrap();
    let press = server.find_type(VENDOR, "PressType").unwrap();
    let machine = server.find_type(MACHINES, "MachineType").unwrap();
    assert!(server.is_subtype_of(&press, &machine));

    let refused = |sets: &[(&str, String)]| match build(sets) {
        Err(ServerError::NodeSet(error)) => error,
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("it was taken: {:?}", sets.first()),
    };
    let message = |name: &str, xml: String| refused(&[(name, xml)]).to_string();
    assert!(matches!(
        refused(&[("vendor", vendor.clone())]),
        NodeSetError::Missing { file, uri } if file == "vendor" && uri == MACHINES
    ));
    assert!(matches!(
        refused(&[("one", machines.clone()), ("two", machines.clone())]),
        NodeSetError::Twice { .. }
    ));
    let circle = machines.replace(
        "<RequiredModel ModelUri=\"http://opcfoundation.org/UA/\"/>",
        "<RequiredModel ModelUri=\"urn:test:vendor\"/>",
    );
    assert!(matches!(
        refused(&[("one", circle), ("two", vendor)]),
        NodeSetError::Circle(files) if files == "one, two"
    ));
    let cut = message("cut.xml", machines[..machines.len() / 2].to_owned());
    assert!(cut.contains("cut.xml is not a NodeSet2 document"), "{cut}");
    let cases = [
        (
            "ns=1;i=1006\" BrowseName",
            "ns=7;i=1006\" BrowseName",
            "namespace 7",
        ),
        (
            ">ns=1;i=1003</Reference>",
            ">ns=1;i=1004</Reference>",
            "refers to itself",
        ),
        (
            "NodeId=\"ns=1;i=1002\"",
            "NodeId=\"ns=1;i=1001\"",
            "two nodes",
        ),
        (
            "ReferenceType=\"GeneratesEvent\"",
            "ReferenceType=\"Generates\"",
            "`Generates`",
        ),
        (
            "BrowseName=\"1:Turn\"",
            "BrowseName=\"9:Turn\"",
            "BrowseName `9:Turn`",
        ),
    ];
    for (from, to, reason) in cases {
        assert!(machines.contains(from), "{from}");
        let said = message("m.xml", machines.replace(from, to));
        assert!(said.starts_with("m.xml") && said.contains(reason), "{said}");
    }
    let said = build_file("/nowhere/vendor.xml");
    assert!(said.contains("/nowhere/vendor.xml"), "{said}");
}

fn build_file(path: &str) -> String {
    let config = ServerConfig::new("urn:a", "a", "opc.tcp://127.0.0.1:0".parse().unwrap());
    let built = ServerBuilder::new(config).nodeset_file(path).build();
    built.err().unwrap().to_string()
}

#[tokio::test]
async fn a_node_that_is_removed_is_gone_for_everybody() {
    let cell = OpcuaCell::new();
    let press = press(&cell.server, 100, &[]);
    let start = press.node("Start").unwrap();
    cell.server
        .on_call(&press.node_id, start, method(|_| Ok(vec![])));
    let client = cell.client().await;
    let force = press.node("ParameterSet/Force").unwrap().clone();
    let mut watched = client.subscribe(
        vec![MonitoredWatch::Value(force)],
        Duration::from_millis(10),
        8,
    );
    assert_eq!(
        next_value(&mut watched).await.1,
        Some(Variant::Double(12.5))
    );
    cell.server.remove(&press.node_id);
    assert_eq!(
        cell::next_status(&mut watched).await,
        StatusCode::BadNodeIdUnknown
    );
    let gone = client
        .call(&press.node_id, start, vec![])
        .await
        .unwrap_err();
    let wanted = CallError::Refused {
        status: StatusCode::BadNodeIdUnknown,
        arguments: vec![],
    };
    assert_eq!(gone, wanted);
    // The object can be created again.
    let again = cell::press(&cell.server, 100, &[]);
    assert_eq!(again, press);
}
