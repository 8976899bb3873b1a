//! Tests of clients with servers that stop, restart, require certificates, or receive garbage from
//! other peers.

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::expect_used,
    reason = "test code"
)]

mod cell;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use cell::{OpcuaCell, PATIENCE, config, next, next_value, press, variable};
use opcua::types::{
    Argument, DataTypeId, LocalizedText, NodeId, ObjectId, QualifiedName, StatusCode, VariableId,
    Variant,
};
use plant_opcua::client::{
    Browse, CallError, CallOptions, ClientConfig, ClientError, Link, MonitoredWatch, Notice,
    OpcUaClient, SecurityChoice,
};
use plant_opcua::server::{
    MethodHandler, MethodRefusal, MethodRequest, MethodSpec, OpcUaServer, ServerConfig,
    ServerSecurity, method,
};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

fn quick() -> ClientConfig {
    let mut config = config();
    config.timeout = Duration::from_secs(2);
    config.keep_alive = Duration::from_millis(100);
    config.backoff = (Duration::from_millis(20), Duration::from_millis(100));
    config
}

async fn until(client: &OpcUaClient, wanted: impl FnMut(&Link) -> bool) -> Link {
    let mut link = client.link();
    let waited = tokio::time::timeout(PATIENCE, link.wait_for(wanted)).await;
    waited.expect("the link never gets there").unwrap().clone()
}

fn is_up(link: &Link) -> bool {
    matches!(link, Link::Up { .. })
}

fn is_down(link: &Link) -> bool {
    matches!(link, Link::Down { .. })
}

#[tokio::test]
async fn a_server_that_is_started_again_is_found_with_all_subscriptions() {
    let first = OpcuaCell::new();
    let url = first.server.url().to_owned();
    press(&first.server, 100, &[]);
    let client = OpcUaClient::open(quick(), &url);
    let link = until(&client, is_up).await;
    assert!(
        matches!(&link, Link::Up { restarted: false, connects: 1, secured: false, application_uri, .. }
        if application_uri == "urn:test:cell"),
        "{link:?}"
    );
    let namespaces = client.namespaces();
    assert_eq!(namespaces[1], "urn:test:cell", "{namespaces:?}");

    let machines = client.namespace(cell::MACHINES).unwrap();
    let path = ["ParameterSet", "Force"].map(|name| QualifiedName::new(machines, name));
    let force = client.translate(&NodeId::new(1, 100), &path).await.unwrap();
    let watches = vec![
        MonitoredWatch::Value(force.clone()),
        MonitoredWatch::Value(NodeId::new(1, 77)),
    ];
    let mut subscription = client.subscribe(watches, Duration::from_millis(10), 64);
    assert_eq!(next(&mut subscription).await, Notice::Subscribed);
    let mut told = [next(&mut subscription).await, next(&mut subscription).await];
    told.sort_by_key(|notice| matches!(notice, Notice::Refused { .. }));
    assert!(
        matches!(&told[0], Notice::Value { watch: 0, value }
        if value.value == Some(Variant::Double(12.5))),
        "{told:?}"
    );
    assert_eq!(
        told[1],
        Notice::Refused {
            watch: 1,
            status: StatusCode::BadNodeIdUnknown
        }
    );

    first.server.stop().await;
    until(&client, is_down).await;
    let refused = client.read(std::slice::from_ref(&force)).await.unwrap_err();
    assert!(matches!(refused, ClientError::NotConnected(_)), "{refused}");

    let again = OpcuaCell::at(&url);
    press(&again.server, 100, &[]);
    again.server.show(&force, 1.5).unwrap();
    let link = until(&client, is_up).await;
    assert!(
        matches!(
            link,
            Link::Up {
                restarted: true,
                connects: 2,
                ..
            }
        ),
        "{link:?}"
    );
    assert_eq!(next(&mut subscription).await, Notice::Subscribed);
    while next(&mut subscription).await
        != (Notice::Refused {
            watch: 1,
            status: StatusCode::BadNodeIdUnknown,
        })
    {}
    again.server.show(&force, 2.5).unwrap();
    while next_value(&mut subscription).await != (0, Some(Variant::Double(2.5))) {}
    assert_eq!(subscription.dropped(), 0);
    client.close().await;
    assert_eq!(*client.link().borrow(), Link::Closed);
    assert_eq!(subscription.next().await, None);
}

#[tokio::test]
async fn a_server_that_says_nothing_more_is_taken_for_down() {
    let cell = OpcuaCell::new();
    // A proxy between client and server stops forwarding, as if a cable were pulled.
    let line = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("opc.tcp://{}", line.local_addr().unwrap());
    let (cut, is_cut) = watch::channel(false);
    let server = format!("127.0.0.1:{}", cell.server.port());
    let relaying = tokio::spawn(async move {
        loop {
            let (mut near, _) = line.accept().await.unwrap();
            let mut far = TcpStream::connect(&server).await.unwrap();
            let mut is_cut = is_cut.clone();
            tokio::spawn(async move {
                let silent = tokio::select! {
                    _ = tokio::io::copy_bidirectional(&mut near, &mut far) => false,
                    _ = is_cut.wait_for(|cut| *cut) => true,
                };
                if silent {
                    std::future::pending::<()>().await;
                }
            });
        }
    });
    let mut config = quick();
    config.timeout = Duration::from_millis(500);
    let client = OpcUaClient::open(config, &url);
    until(&client, is_up).await;
    cut.send_replace(true);
    let Link::Down { reason, .. } = until(&client, is_down).await else {
        panic!()
    };
    assert!(reason.contains("does not respond"), "{reason}");
    cut.send_replace(false);
    until(&client, is_up).await;
    relaying.abort();
}

#[tokio::test]
async fn a_queue_that_is_full_loses_notices_and_counts_them() {
    let cell = OpcuaCell::new();
    let press = press(&cell.server, 100, &[]);
    let client = cell.client().await;
    let force = press.node("ParameterSet/Force").unwrap().clone();
    let watches = vec![MonitoredWatch::Value(force.clone())];
    let mut full = client.subscribe(watches.clone(), Duration::from_millis(10), 2);
    let mut roomy = client.subscribe(watches, Duration::from_millis(10), 64);
    next_value(&mut roomy).await;
    let mut n = 0.0;
    while full.dropped() == 0 {
        n += 1.0;
        cell.server.show(&force, n).unwrap();
        assert_eq!(next_value(&mut roomy).await, (0, Some(Variant::Double(n))));
    }
    // The first notices are still in the queue.
    assert_eq!(next(&mut full).await, Notice::Subscribed);
    assert_eq!(roomy.dropped(), 0);
}

/// A method that waits before it takes effect. The channel has what happened last.
struct Slow(watch::Sender<&'static str>);

/// Notes that a waiting call is dropped.
struct Waiting(watch::Sender<&'static str>);

impl Drop for Waiting {
    fn drop(&mut self) {
        self.0.send_if_modified(|last| {
            let waits = *last == "waits";
            if waits {
                *last = "is dropped";
            }
            waits
        });
    }
}

#[async_trait]
impl MethodHandler for Slow {
    async fn call(&self, _request: MethodRequest) -> Result<Vec<Variant>, MethodRefusal> {
        self.0.send_replace("waits");
        let _waiting = Waiting(self.0.clone());
        tokio::time::sleep(Duration::from_secs(1)).await;
        self.0.send_replace("has taken effect");
        Ok(Vec::new())
    }
}

#[tokio::test]
async fn a_call_takes_no_effect_after_its_caller_has_given_up_where_timeout_hints_are_obeyed() {
    for (obeys_timeout_hints, expected) in [(true, "is dropped"), (false, "has taken effect")] {
        let config = ServerConfig {
            obeys_timeout_hints,
            ..ServerConfig::new(
                "urn:test:cell",
                "Cell",
                "opc.tcp://127.0.0.1:0".parse().unwrap(),
            )
        };
        let cell = OpcuaCell::with(config);
        let (last, mut happened) = watch::channel("nothing");
        press(&cell.server, 100, &[]);
        let (object, id) = (NodeId::new(1, 100), NodeId::new(1, 500));
        let method = MethodSpec {
            node_id: id.clone(),
            browse_name: QualifiedName::new(1, "Slow"),
            object: object.clone(),
            arguments: (NodeId::new(1, 501), NodeId::new(1, 502)),
            takes: Vec::new(),
            gives: Vec::new(),
        };
        cell.server
            .add_method(method, Arc::new(Slow(last)))
            .unwrap();
        let client = cell.client().await;
        let options = CallOptions {
            within: Duration::from_millis(200),
            connection: None,
        };
        let called = client.call_result((&object, &id), Vec::new(), options);
        let error = called.await.unwrap_err();
        assert!(matches!(error, ClientError::Lost(_)), "{error}");
        let ended = happened.wait_for(|last| !["nothing", "waits"].contains(last));
        let ended = tokio::time::timeout(PATIENCE, ended).await;
        assert_eq!(*ended.expect("it waits").unwrap(), expected);
    }
}

#[tokio::test]
async fn a_method_below_objects_is_called() {
    let cell = OpcuaCell::new();
    let objects: NodeId = ObjectId::ObjectsFolder.into();
    let id = NodeId::new(1, 500);
    let spec = MethodSpec {
        node_id: id.clone(),
        browse_name: QualifiedName::new(1, "Count"),
        object: objects.clone(),
        arguments: (NodeId::new(1, 501), NodeId::new(1, 502)),
        takes: vec![Argument {
            name: "names".into(),
            data_type: DataTypeId::String.into(),
            value_rank: 1,
            array_dimensions: None,
            description: LocalizedText::null(),
        }],
        gives: Vec::new(),
    };
    let count = method(|_| Ok(vec![Variant::UInt32(3)]));
    cell.server.add_method(spec, count).unwrap();
    let client = cell.client().await;
    let names = vec![Variant::from(vec!["a".to_owned()])];
    let counted = client.call(&objects, &id, names).await.unwrap();
    assert_eq!(counted, [Variant::UInt32(3)]);
    // Clients read the arguments; the array has any length.
    let takes = client.read(&[NodeId::new(1, 501)]).await.unwrap();
    let Some(Variant::Array(takes)) = &takes[0].value else {
        panic!("{takes:?}");
    };
    let [Variant::ExtensionObject(names)] = takes.values.as_slice() else {
        panic!("{takes:?}");
    };
    let names = names.inner_as::<Argument>().unwrap();
    assert_eq!(names.array_dimensions, Some(vec![0]));
    // The method is not a method of other objects.
    let server: NodeId = ObjectId::Server.into();
    let elsewhere = client.call(&server, &id, Vec::new()).await.unwrap_err();
    let is_invalid = matches!(elsewhere, CallError::Refused { status, .. }
        if status == StatusCode::BadMethodInvalid);
    assert!(is_invalid, "{elsewhere}");
}

fn scratch(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("plant-opcua-{}-{name}", std::process::id()));
    drop(std::fs::remove_dir_all(&path));
    path
}

fn secured(name: &str, trust: bool) -> (OpcuaCell, PathBuf) {
    let pki = scratch(name);
    let url = "opc.tcp://127.0.0.1:0".parse().unwrap();
    let config = ServerConfig {
        security: vec![ServerSecurity::None, ServerSecurity::Basic256Sha256],
        pki: Some(pki.clone()),
        trust_unknown_clients: trust,
        ..ServerConfig::new("urn:test:cell", "Cell", url)
    };
    (OpcuaCell::with(config), pki)
}

#[tokio::test]
async fn a_client_with_certificates_has_the_best_security_there_is() {
    let (cell, server_pki) = secured("server", false);
    let client_pki = scratch("client");
    let mut config = config();
    config.pki = Some(client_pki.clone());
    config.backoff = (Duration::from_millis(20), Duration::from_millis(100));
    let strict = OpcUaClient::open(config.clone(), cell.server.url());
    let is_refused = |link: &Link| matches!(link, Link::Down { reason, .. } if !reason.is_empty());
    until(&strict, is_refused).await;
    strict.close().await;
    config.accept_untrusted = true;
    let client = OpcUaClient::open(config, cell.server.url());
    until(&client, is_refused).await;
    // The server does not trust the client's certificate until an operator trusts it.
    for rejected in std::fs::read_dir(server_pki.join("rejected")).unwrap() {
        let path = rejected.unwrap().path();
        std::fs::rename(
            &path,
            server_pki.join("trusted").join(path.file_name().unwrap()),
        )
        .unwrap();
    }
    let link = until(&client, is_up).await;
    assert!(matches!(link, Link::Up { secured: true, .. }), "{link:?}");
    let start: NodeId = VariableId::Server_ServerStatus_StartTime.into();
    let read = client.read(&[start]).await.unwrap();
    assert!(
        matches!(read[0].value, Some(Variant::DateTime(_))),
        "{read:?}"
    );
    client.close().await;

    let mut plain = cell::config();
    plain.security = SecurityChoice::None;
    let client = OpcUaClient::open(plain, cell.server.url());
    let link = until(&client, is_up).await;
    assert!(matches!(link, Link::Up { secured: false, .. }), "{link:?}");
    for path in [server_pki, client_pki] {
        std::fs::remove_dir_all(path).unwrap();
    }
}

/// Returns invalid messages of a peer.
fn garbage(url: &str) -> Vec<Vec<u8>> {
    let message = |kind: &[u8], size: u32, rest: &[u8]| {
        let mut bytes = kind.to_vec();
        bytes.extend(size.to_le_bytes());
        bytes.extend(rest);
        bytes
    };
    let mut hello = Vec::new();
    for number in [0_u32, 65_536, 65_536, 0, 0] {
        hello.extend(number.to_le_bytes());
    }
    hello.extend(u32::try_from(url.len()).unwrap().to_le_bytes());
    hello.extend(url.as_bytes());
    let size = u32::try_from(hello.len() + 8).unwrap();
    let hello_of = |size| message(b"HELF", size, &hello);
    let after = |rest: Vec<u8>| [hello_of(size), rest].concat();
    vec![
        b"GET / HTTP/1.1\r\nHost: cell\r\n\r\n".to_vec(),
        vec![0; 64],
        vec![0xff; 4_096],
        message(b"HELF", 8, &[]),
        message(b"HELF", u32::MAX, &[0; 32]),
        hello_of(size - 5),
        hello_of(size + 1_000_000),
        // A URL length beyond the end of the message.
        message(
            b"HELF",
            32,
            &[[0_u8; 20].as_slice(), &[0xff, 0xff, 0xff, 0x7f]].concat(),
        ),
        after(message(b"OPNF", 8, &[])),
        after(message(b"OPNF", 0, &[0; 64])),
        after(message(b"OPNF", 64, &[0xff; 56])),
        after(message(b"OPNC", 65_000, &[0; 2_000])),
        after(message(b"MSGF", 24, &[0; 16])),
        after(message(b"MSGF", 7, &[])),
        after(message(b"CLOF", 24, &[0x7f; 16])),
        after(message(b"XXXF", 16, &[0; 8])),
        after(hello_of(size)),
    ]
}

#[tokio::test]
async fn a_peer_that_sends_garbage_disturbs_nobody() {
    let cell = OpcuaCell::new();
    let press = press(&cell.server, 100, &[]);
    let force = press.node("ParameterSet/Force").unwrap().clone();
    let client = OpcUaClient::open(quick(), cell.server.url());
    client.up(PATIENCE).await.unwrap();
    let watches = vec![MonitoredWatch::Value(force.clone())];
    let mut subscription = client.subscribe(watches, Duration::from_millis(10), 256);
    assert_eq!(
        next_value(&mut subscription).await.1,
        Some(Variant::Double(12.5))
    );
    let authority = format!("127.0.0.1:{}", cell.server.port());
    let garbage = garbage(cell.server.url());
    for (n, bytes) in garbage.iter().enumerate() {
        let mut peer = TcpStream::connect(&authority).await.unwrap();
        // The server may close the connection before it has read everything.
        drop(peer.write_all(bytes).await);
        // Meanwhile a client receives every value.
        let shown = f64::from(u32::try_from(n).unwrap());
        cell.server.show(&force, shown).unwrap();
        assert_eq!(
            next_value(&mut subscription).await,
            (0, Some(Variant::Double(shown)))
        );
        let read = client.read(std::slice::from_ref(&force)).await.unwrap();
        assert_eq!(read[0].value, Some(Variant::Double(shown)), "beside {n}");
        drop(peer.shutdown().await);
        let mut answer = Vec::new();
        let closed = tokio::time::timeout(PATIENCE, peer.read_to_end(&mut answer)).await;
        assert!(closed.is_ok(), "{n} is held open");
        assert!(answer.len() < 1_024, "{n} gets {} bytes", answer.len());
    }
    assert!(matches!(
        *client.link().borrow(),
        Link::Up { connects: 1, .. }
    ));
    still_serves(&cell.server).await;
}

async fn still_serves(server: &OpcUaServer) {
    let client = OpcUaClient::open(quick(), server.url());
    client.up(PATIENCE).await.unwrap();
    let root: NodeId = ObjectId::ObjectsFolder.into();
    let below = client.browse(&root, Browse::hierarchical()).await.unwrap();
    assert!(!below.is_empty());
}

/// Creates a server of the library that accepts few operations in a request and few items in a
/// subscription.
async fn small_server() -> (String, opcua::server::ServerHandle) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let mut builder = opcua::server::ServerBuilder::new_anonymous("small")
        .application_uri("urn:test:small")
        .host("127.0.0.1")
        .port(port);
    let limits = builder.limits_mut();
    limits.operational.max_nodes_per_read = 10;
    limits.operational.max_nodes_per_write = 10;
    limits.operational.max_monitored_items_per_call = 10;
    limits.subscriptions.max_monitored_items_per_sub = 25;
    let (server, handle) = builder.build().unwrap();
    tokio::spawn(server.run_with(listener));
    (format!("opc.tcp://127.0.0.1:{port}"), handle)
}

#[tokio::test]
async fn a_server_with_small_limits_is_asked_in_parts() {
    let (url, server) = small_server().await;
    let client = OpcUaClient::open(quick(), &url);
    until(&client, is_up).await;
    let state: NodeId = VariableId::Server_ServerStatus_State.into();
    let values = client.read(&vec![state.clone(); 40]).await.unwrap();
    assert_eq!(values.len(), 40);
    assert!(
        values.iter().all(|value| value.value.is_some()),
        "{values:?}"
    );

    // The server refuses each value individually, because the variable is not writable.
    let written = client
        .write_each(&vec![(state.clone(), Variant::Int32(0)); 15])
        .await;
    assert_eq!(written.len(), 15);
    for result in written {
        let status = result.unwrap();
        assert!(
            status.is_bad() && status != StatusCode::BadTooManyOperations,
            "{status}"
        );
    }

    let watches = vec![MonitoredWatch::Value(state); 60];
    let mut subscription = client.subscribe(watches, Duration::from_millis(10), 256);
    assert_eq!(next(&mut subscription).await, Notice::Subscribed);
    let mut seen = std::collections::BTreeSet::new();
    while seen.len() < 60 {
        seen.insert(next_value(&mut subscription).await.0);
    }
    client.close().await;
    server.cancel();
}

#[tokio::test]
async fn references_are_browsed_page_by_page_up_to_a_number() {
    let cell = OpcuaCell::new();
    let folder: NodeId = ObjectId::ObjectsFolder.into();
    for n in 0..25_usize {
        let node = NodeId::new(1, u32::try_from(9000 + n).unwrap());
        cell.server
            .add_variable(&variable(&node, &folder, n))
            .unwrap();
    }
    let client = cell.client().await;
    let nodes = [folder.clone(), NodeId::new(1, 77_777_u32), folder];
    let what = Browse::hierarchical();
    let all = client
        .browse_within(&nodes, &what, (1000, 4))
        .await
        .unwrap();
    let [first, missing, second] = all.as_slice() else {
        panic!("{all:?}")
    };
    assert!(first.is_whole && first.references.len() >= 25);
    assert_eq!(first, second);
    assert_eq!(missing.status, StatusCode::BadNodeIdUnknown);
    let few = client.browse_within(&nodes, &what, (10, 4)).await.unwrap();
    let counts: Vec<usize> = few.iter().map(|one| one.references.len()).collect();
    assert_eq!(counts, [10, 0, 0]);
    assert!(!few[0].is_whole && !few[2].is_whole);
}
