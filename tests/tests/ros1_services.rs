//! Services of `tcpros` with the clients, servers and tools of real ROS 1.

use std::{
    io::{Read, Write},
    net::TcpStream,
    time::{Duration, Instant},
};

use bytes::Bytes;
use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, MASTER, Peer, eventually, xml_rpc};
use tcpros::{
    CallPhase, ConnectionHeader, Node, NodeOptions, ServiceClient, ServiceClientOptions,
    ServiceError, ServiceOptions, ServiceServer, ServiceTypeSum,
};
use tokio::runtime::Runtime;

const SOON: Duration = Duration::from_secs(30);
const SERVICE: &str = "/grip";
const MD5: &str = "09fb03525b03e7ea1fd3992bafd87e16";
/// `SetBoolResponse(True, "done")`.
const DONE: &[u8] = b"\x01\x04\0\0\0done";

/// A node of `tcpros`, served by a thread in the cell's network while the test waits for its peers.
struct Ours {
    runtime: Runtime,
    node: Node,
}

impl Ours {
    fn start(name: &str) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let mut options = NodeOptions::from_env(name);
        options.master_uri = format!("http://{MASTER}");
        options.namespace = "/".to_owned();
        options.advertise_as("127.0.0.1");
        let entered = runtime.enter();
        let node = Node::start(options).unwrap();
        drop(entered);
        Self { runtime, node }
    }

    /// Offers `std_srvs/SetBool`: true succeeds, false fails.
    fn offer(&self, service: &str) -> ServiceServer {
        let service_type = ServiceTypeSum {
            name: "std_srvs/SetBool".to_owned(),
            md5sum: MD5.to_owned(),
            request_type: "std_srvs/SetBoolRequest".to_owned(),
            response_type: "std_srvs/SetBoolResponse".to_owned(),
        };
        let handler = async |on: bool| match on {
            true => Ok(Bytes::from_static(DONE)),
            false => Err("the valve is stuck".to_owned()),
        };
        let server = self
            .node
            .advertise_service(
                service,
                service_type,
                ServiceOptions::default(),
                move |request| handler(request.bytes[0] != 0),
            )
            .unwrap();
        eventually("the service is registered", SOON, || uri(service));
        server
    }

    fn client(&self, options: ServiceClientOptions) -> ServiceClient {
        self.node.service_client(SERVICE, options).unwrap()
    }

    fn call(&self, client: &ServiceClient, on: bool) -> Result<Bytes, ServiceError> {
        let request = Bytes::from_static(if on { &[1] } else { &[0] });
        self.runtime.block_on(client.call(request))
    }

    fn shutdown(self) {
        self.runtime.block_on(self.node.shutdown());
    }
}

fn persistent() -> ServiceClientOptions {
    ServiceClientOptions {
        persistent: true,
        ..Default::default()
    }
}

/// Returns the address of a service from the master, as `127.0.0.1:40001`; `None` while the master
/// knows no server.
fn uri(service: &str) -> Option<String> {
    let answer = xml_rpc(MASTER, "lookupService", &["/system_tests", service])?;
    // The address is in the message and then, last, in the result.
    let (_, rest) = answer.rsplit_once("rosrpc://")?;
    Some(rest.split(['/', '<']).next()?.to_owned())
}

fn state() -> String {
    xml_rpc(MASTER, "getSystemState", &["/system_tests"]).unwrap()
}

fn value(line: &Value) -> Option<Value> {
    line.get("value").cloned()
}

fn error(line: &Value) -> Option<String> {
    Some(line.get("error")?.as_str()?.to_owned())
}

/// Connects to our service as a hand-written client, and exchanges the headers.
fn client_by_hand(fields: &[(&str, &str)]) -> TcpStream {
    let mut stream = TcpStream::connect(uri(SERVICE).unwrap()).unwrap();
    stream.set_read_timeout(Some(SOON)).unwrap();
    let header = fields
        .iter()
        .fold(ConnectionHeader::default(), |h, (name, value)| {
            h.with(name, *value)
        })
        .with("service", SERVICE)
        .with("callerid", "/by_hand");
    stream.write_all(&header.encode().unwrap()).unwrap();
    let mut length = [0; 4];
    stream.read_exact(&mut length).unwrap();
    let mut reply = vec![0; u32::from_le_bytes(length) as usize];
    stream.read_exact(&mut reply).unwrap();
    stream
}

#[test]
fn rosservice_lists_describes_and_calls_our_service() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ours::start("arm");
    let server = ours.offer(SERVICE);
    let rosservice = |args: &[&str]| cell.ros1_tool("rosservice", args).join("\n");
    assert_eq!(rosservice(&["list"]), SERVICE);
    assert_eq!(rosservice(&["type", SERVICE]), "std_srvs/SetBool");
    let address = format!("rosrpc://{}", uri(SERVICE).unwrap());
    assert_eq!(rosservice(&["uri", SERVICE]), address);
    let info = rosservice(&["info", SERVICE]);
    for part in [
        "Node: /arm",
        &address,
        "Type: std_srvs/SetBool",
        "Args: data",
    ] {
        assert!(info.contains(part), "{info}");
    }
    assert_eq!(server.calls(), 0);
    let answer = rosservice(&["call", SERVICE, "true"]);
    assert!(
        answer.contains("success: True") && answer.contains("done"),
        "{answer}"
    );
    assert_eq!((server.calls(), server.refused()), (1, 0));
}

#[test]
fn rospy_calls_our_service_also_on_a_kept_connection_and_with_another_type() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ours::start("arm");
    let server = ours.offer(SERVICE);
    let values = [
        "--value",
        r#"{"data":true}"#,
        "--value",
        r#"{"data":false}"#,
    ];
    for (kept, calls) in [(&[][..], 2), (&["--persistent"][..], 4)] {
        let args = [&[SERVICE, "std_srvs/SetBool"][..], &values, kept].concat();
        let mut rospy = cell.rospy("ros1_call.py", &args);
        assert_eq!(
            rospy.wait_for_json("an answer", SOON, value),
            json!({"success": true, "message": "done"})
        );
        let told = rospy.wait_for_json("an error", SOON, error);
        assert!(told.contains("the valve is stuck"), "{told}");
        assert!(rospy.wait_for_end(SOON).success());
        assert_eq!((server.calls(), server.failures()), (calls, calls / 2));
    }
    let other = [SERVICE, "std_srvs/Trigger", "--value", "{}"];
    let mut rospy = cell.rospy("ros1_call.py", &other);
    let told = rospy.wait_for_json("an error", SOON, error);
    assert!(
        told.contains("to have md5sum") && told.contains(MD5),
        "{told}"
    );
    assert_eq!(server.refused(), 1);
}

#[test]
fn our_client_calls_a_rospy_server_of_known_and_of_unknown_type() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ours::start("cell");
    let mut rospy = cell.rospy("ros1_serve.py", &[SERVICE]);
    let of = |md5sum: &str| ServiceClientOptions {
        md5sum: Some(md5sum.to_owned()),
        ..Default::default()
    };
    for options in [ServiceClientOptions::default(), of(MD5), persistent()] {
        let client = ours.client(options);
        assert_eq!(ours.call(&client, true).unwrap(), DONE);
        let failed = ours.call(&client, false).unwrap_err();
        assert!(
            matches!(&failed, ServiceError::Failed { message, .. } if message.contains("valve is stuck")),
            "{failed}"
        );
        assert_eq!(ours.call(&client, true).unwrap(), DONE);
    }
    rospy.wait_for_json("the caller, on a kept connection", SOON, |line| {
        (line["callerid"] == "/cell" && line["persistent"] == true).then_some(())
    });
    eventually("nine calls are told of", SOON, || {
        (rospy.values().len() == 9).then_some(())
    });

    let refused = ours
        .call(&ours.client(of(&"0".repeat(32))), true)
        .unwrap_err();
    assert!(
        matches!(&refused, ServiceError::Refused { message, .. } if message.contains("md5sums do not match")),
        "{refused}"
    );
    let probing = ours.client(ServiceClientOptions::default());
    let header = ours.runtime.block_on(probing.probe()).unwrap();
    assert_eq!(header.type_name(), Some("std_srvs/SetBool"));
    assert_eq!(
        (header.md5sum(), header.caller_id()),
        (Some(MD5), "/rospy_server")
    );
}

#[test]
fn a_server_killed_and_started_again_is_found_by_the_next_call() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ours::start("cell");
    let client = ours.client(persistent());
    let mut first = cell.rospy("ros1_serve.py", &[SERVICE]);
    assert_eq!(ours.call(&client, true).unwrap(), DONE);
    let before = uri(SERVICE);
    first.signal(Signal::SIGKILL);
    first.wait_for_end(SOON);

    let stale = ours.call(&client, true).unwrap_err();
    assert!(stale.to_string().contains("rosnode cleanup"), "{stale}");
    assert!(
        matches!(stale, ServiceError::NoConnection { .. }),
        "{stale}"
    );

    let _second = cell.rospy("ros1_serve.py", &[SERVICE, "--node", "second"]);
    assert_ne!(uri(SERVICE), before);
    assert_eq!(ours.call(&client, true).unwrap(), DONE);
}

#[test]
fn a_stopped_server_costs_the_time_limit() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ours::start("cell");
    let rospy = cell.rospy("ros1_serve.py", &[SERVICE]);
    let client = ours.client(ServiceClientOptions {
        timeout: Duration::from_millis(500),
        ..persistent()
    });
    let warm = eventually("the first answer", SOON, || ours.call(&client, true).ok());
    assert_eq!(warm, DONE);
    rospy.signal(Signal::SIGSTOP);
    let start = Instant::now();
    let late = ours.call(&client, true).unwrap_err();
    assert!(start.elapsed() < Duration::from_secs(5));
    assert!(
        matches!(
            late,
            ServiceError::Timeout {
                phase: CallPhase::Answer,
                ..
            }
        ),
        "{late}"
    );
    assert!(late.may_have_run());
    // The operating system still accepts connections, but no process answers.
    let late = ours.call(&client, true).unwrap_err();
    assert!(
        matches!(
            late,
            ServiceError::Timeout {
                phase: CallPhase::Handshake,
                ..
            }
        ),
        "{late}"
    );
    assert!(!late.may_have_run());
    rospy.signal(Signal::SIGCONT);
    let again = eventually("an answer again", SOON, || ours.call(&client, true).ok());
    assert_eq!(again, DONE);
}

#[test]
fn rosrust_calls_our_service_and_we_call_its() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ours::start("arm");
    let server = ours.offer(SERVICE);
    let mut rosrust = cell.rosrust(&["call", SERVICE]);
    assert_eq!(
        rosrust.wait_for_json("an answer", SOON, value),
        json!("done")
    );
    let told = rosrust.wait_for_json("an error", SOON, error);
    assert_eq!(told, "the valve is stuck");
    assert_eq!((server.calls(), server.failures()), (2, 1));
    drop(server);
    eventually("the service is withdrawn", SOON, || {
        uri(SERVICE).is_none().then_some(())
    });

    let _rosrust = cell.rosrust(&["serve", SERVICE]);
    // rosrust closes the connection after each answer, and rejects `*`.
    let client = ours.client(ServiceClientOptions {
        md5sum: Some(MD5.to_owned()),
        ..persistent()
    });
    for _ in 0..20 {
        assert_eq!(ours.call(&client, true).unwrap(), DONE);
    }
    let failed = ours.call(&client, false).unwrap_err();
    assert!(
        matches!(&failed, ServiceError::Failed { message, .. } if message == "the valve is stuck"),
        "{failed}"
    );
}

#[test]
fn clients_that_break_the_protocol_do_not_stop_rospy() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ours::start("arm");
    let server = ours.offer(SERVICE);
    let any = [("md5sum", "*")];
    let mut open = Vec::new();
    for garbage in [
        b"\xff\xff\xff\xff".as_slice(),
        b"GET / HTTP/1.1\r\n\r\n",
        b"\x04\0\0\0\xff\xff\xff\x7f",
        b"",
    ] {
        let mut stream = TcpStream::connect(uri(SERVICE).unwrap()).unwrap();
        stream.write_all(garbage).unwrap();
        open.push(stream);
    }
    for request in [
        b"\0\0\0\x80\x01".as_slice(),
        b"\x09\0\0\0\x01",
        b"\x01",
        b"",
    ] {
        let mut stream = client_by_hand(&any);
        stream.write_all(request).unwrap();
        open.push(stream);
    }
    for _ in 0..20 {
        let mut stream = client_by_hand(&any);
        stream.write_all(b"\x01\0\0\0\x01").unwrap();
        let now = Some(Duration::ZERO);
        socket2::SockRef::from(&stream).set_linger(now).unwrap();
    }
    let args = [SERVICE, "std_srvs/SetBool", "--value", r#"{"data":true}"#];
    let mut rospy = cell.rospy("ros1_call.py", &args);
    rospy.wait_for_json("an answer", SOON, value);
    drop(open);
    let mut rospy = cell.rospy("ros1_call.py", &args);
    rospy.wait_for_json("an answer", SOON, value);
    eventually("all others are gone", SOON, || {
        (server.clients() == 0).then_some(())
    });
    assert!(server.refused() >= 3, "{}", server.refused());
}

#[test]
fn a_service_survives_the_master_and_leaves_nothing_in_it() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let mut master = cell.roscore();
    let ours = Ours::start("arm");
    let server = ours.offer(SERVICE);
    let _more: Vec<_> = (0..200).map(|n| ours.offer(&format!("/s{n}"))).collect();
    let client = ours.client(persistent());
    assert_eq!(ours.call(&client, true).unwrap(), DONE);
    master.signal(Signal::SIGKILL);
    master.wait_for_end(SOON);
    assert_eq!(ours.call(&client, true).unwrap(), DONE);

    let _master = cell.roscore();
    eventually("the services are registered again", SOON, || {
        (state().matches("/arm").count() == 201).then_some(())
    });
    assert_eq!(ours.call(&ours.client(persistent()), true).unwrap(), DONE);
    assert_eq!(server.calls(), 3);
    ours.shutdown();
    assert!(!state().contains("/arm"), "{}", state());
}

#[test]
fn of_two_nodes_with_one_service_the_last_serves_and_the_first_may_leave() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ours::start("arm");
    let server = ours.offer(SERVICE);
    let rospy = cell.rospy("ros1_serve.py", &[SERVICE]);
    let client = ours.client(ServiceClientOptions::default());
    assert_eq!(ours.call(&client, true).unwrap(), DONE);
    eventually("the last one has served", SOON, || {
        (rospy.values().len() == 1).then_some(())
    });
    assert_eq!(server.calls(), 0);
    drop(server);
    let other = ours.offer("/other");
    assert_eq!(ours.call(&client, true).unwrap(), DONE);
    drop(other);
    ours.shutdown();
    assert!(uri(SERVICE).is_some());
}

#[test]
fn a_thousand_calls_leave_no_file_descriptor_behind() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let open = || std::fs::read_dir("/proc/self/fd").unwrap().count();
    let _master = cell.roscore();
    let ours = Ours::start("cell");
    let _rospy = cell.rospy("ros1_serve.py", &[SERVICE]);
    let client = ours.client(ServiceClientOptions::default());
    assert_eq!(ours.call(&client, true).unwrap(), DONE);
    let before = open();
    for _ in 0..1000 {
        assert_eq!(ours.call(&client, true).unwrap(), DONE);
    }
    // Except for the connections of the node's watchdog, which come and go.
    eventually("all connections are closed", SOON, || {
        (open() <= before + 2).then_some(())
    });
}
