//! The round-trip times of a skill, an OPC UA method, a ROS 1 service, a ROS 2 service and UADP,
//! for payloads of 8 B to 1 MiB, idle, with both cores busy, and with a loaded network.

use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use plant_opcua::client::{ClientConfig, OpcUaClient};
use plant_opcua::server::{
    MethodRequest, MethodSpec, OpcUaServer, ServerBuilder, ServerConfig, method,
};
use plant_opcua::types::{
    Argument, ByteString, DataTypeId, LocalizedText, NodeId, ObjectId, QualifiedName, Variant,
};
use ros2_node::domain::{Domain, DomainOptions};
use ros2_node::service::{self, ServiceName, ServicePeers, ServiceTypes};
use skills::{ClientOptions, ParameterType, RunnableSkill as _, SkillClient, SkillHandle};
use socket2::SockRef;
use system_tests::{Cell, Child, StartedChild, Times, program};
use tcpros::{Core, Node, NodeOptions, ServiceClientOptions, ServiceOptions, ServiceTypeSum};
use uadp::{
    ChunkBudget, ChunkEncoder, DataSetHeader, Extras, NetworkHeader, NetworkMessage,
    NetworkMessageEncoder, NetworkMessageType, PublisherId, Reassembler, Scalar, Variant as Field,
    Whole,
};

/// Measures all paths, and prints a table.
pub(crate) fn all(runs: usize) -> Option<()> {
    let cell = Cell::with(&[])?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .ok()?;
    runtime.block_on(async {
        let mut paths = Paths::stand(&cell).await;
        println!(
            "\n{runs} round trips each, one at a time, p50 / p99 in microseconds; the component of the \
             skill is another process, the other servers are in the process of the client:\n"
        );
        println!("| path | load | 8 B | 1 KiB | 64 KiB | 1 MiB |");
        println!("|---|---|---|---|---|---|");
        for name in NAMES {
            for load in [Load::None, Load::Cores, Load::Network] {
                let loaded = load.start();
                let mut cells = Vec::new();
                for size in SIZES {
                    cells.push(paths.measure(name, size, runs).await);
                }
                println!("| {name} | {} | {} |", load.name(), cells.join(" | "));
                drop(loaded);
            }
        }
    });
    Some(())
}

const NAMES: [&str; 5] = [
    "UADP value there and back",
    "ROS 1 service",
    "OPC UA method",
    "ROS 2 service",
    "skill: run until its outcome",
];
const SIZES: [usize; 4] = [8, 1 << 10, 64 << 10, 1 << 20];
/// Number of unmeasured round trips before the first.
const WARM: usize = 3;

/// The clients and servers of all paths.
struct Paths {
    uadp: Echo,
    ros1: tcpros::ServiceClient,
    opcua: OpcUaClient,
    ros2: service::ServiceClient,
    skill: SkillHandle,
    _servers: Servers,
}

/// Keeps the servers alive.
struct Servers {
    _core: Core,
    _nodes: [Node; 2],
    _ros1: tcpros::ServiceServer,
    _opcua: OpcUaServer,
    _domains: [Domain; 2],
    _ros2: service::ServiceServer,
    _component: Child,
    _skills: SkillClient,
}

impl Paths {
    async fn stand(cell: &Cell) -> Self {
        let core = Core::start(([127, 0, 0, 1], 0).into()).unwrap();
        let nodes = ["server", "client"].map(|name| {
            let mut options = NodeOptions::from_env(name);
            core.uri().clone_into(&mut options.master_uri);
            "/".clone_into(&mut options.namespace);
            options.advertise_as("127.0.0.1");
            Node::start(options).unwrap()
        });
        let ros1 = nodes[0]
            .advertise_service(
                "/echo",
                echo_type(),
                ServiceOptions::default(),
                async |request: tcpros::ServiceRequest| Ok(request.bytes),
            )
            .unwrap();
        let options = ServiceClientOptions {
            persistent: true,
            ..ServiceClientOptions::default()
        };
        let ros1_client = nodes[1].service_client("/echo", options).unwrap();
        let opcua = opcua_server();
        let config = ClientConfig {
            timeout: SOON,
            ..ClientConfig::new("urn:ua-bridge:bench:client", "bench")
        };
        let opcua_client = OpcUaClient::open(config, opcua.url());
        opcua_client.up(SOON).await.unwrap();
        let domains = ["server", "client"].map(domain);
        let ros2 = service::ServiceServer::open(
            &domains[0],
            &ServicePeers::new(&domains[0]),
            &ros2_service(),
            service::ServiceOptions::default(),
            async |request: service::ServiceRequest| Ok(request.bytes),
        )
        .unwrap();
        let ros2_client = service::ServiceClient::open(
            &domains[1],
            &ServicePeers::new(&domains[1]),
            &ros2_service(),
            service::ServiceClientOptions::default(),
        )
        .unwrap();
        let (component, skills, skill) = skill(cell).await;
        Self {
            uadp: Echo::start(),
            ros1: ros1_client,
            opcua: opcua_client,
            ros2: ros2_client,
            skill,
            _servers: Servers {
                _core: core,
                _nodes: nodes,
                _ros1: ros1,
                _opcua: opcua,
                _domains: domains,
                _ros2: ros2,
                _component: component,
                _skills: skills,
            },
        }
    }

    /// Returns p50 and p99 of a path and a size, or the reason why there are none.
    async fn measure(&mut self, name: &str, size: usize, runs: usize) -> String {
        let payload = vec![b'x'; size];
        let (mut times, mut lost) = (Times::default(), 0);
        for turn in 0..runs + WARM {
            let began = Instant::now();
            let result = self.turn(name, &payload).await;
            match result {
                Ok(()) if turn >= WARM => times.add(began.elapsed()),
                Ok(()) => {}
                Err(why) if lost >= MOST_LOST => return format!("- ({why})"),
                Err(_) => lost += 1,
            }
        }
        let figures = format!("{:.0} / {:.0}", times.at(0.5), times.at(0.99));
        match lost {
            0 => figures,
            lost => format!("{figures} ({lost} lost)"),
        }
    }

    async fn turn(&mut self, name: &str, payload: &[u8]) -> Result<(), String> {
        match name {
            "UADP value there and back" => self.uadp.turn(payload),
            "ROS 1 service" => {
                let request = with_length(&[], payload);
                let reply = self.ros1.call(request.into()).await;
                same_length(reply.map_err(|error| error.to_string())?.len(), payload, 4)
            }
            "ROS 2 service" => {
                let request = with_length(&CDR, payload);
                let reply = self.ros2.call(request.into()).await;
                same_length(reply.map_err(|error| error.to_string())?.len(), payload, 8)
            }
            "OPC UA method" => {
                let object: NodeId = ObjectId::ObjectsFolder.into();
                let argument = Variant::ByteString(ByteString::from(payload.to_vec()));
                let echo = NodeId::new(1, ECHO);
                let called = self.opcua.call(&object, &echo, vec![argument]);
                let results = called.await.map_err(|error| error.to_string())?;
                let Some(Variant::ByteString(bytes)) = results.first() else {
                    return Err("no result".to_owned());
                };
                let length = bytes.value.as_ref().map_or(0, Vec::len);
                same_length(length, payload, 0)
            }
            _ => {
                let object = String::from_utf8_lossy(payload).into_owned();
                let given = vec![("ToolAppUri".to_owned(), object.into())];
                let outcome = self.skill.run(given, SOON).await;
                outcome.map(drop).map_err(|error| error.to_string())
            }
        }
    }
}

/// Returns a payload with its length before it, as strings and lists of bytes have in ROS.
fn with_length(before: &[u8], payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).unwrap();
    [before, &length.to_le_bytes(), payload].concat()
}

fn same_length(length: usize, payload: &[u8], more: usize) -> Result<(), String> {
    match length == payload.len() + more {
        true => Ok(()),
        false => Err(format!("{length} bytes are returned")),
    }
}

/// Returns a type of a request and a response with a list of bytes.
fn echo_type() -> ServiceTypeSum {
    ServiceTypeSum {
        name: "bench/Echo".to_owned(),
        md5sum: "0".repeat(32),
        request_type: "bench/EchoRequest".to_owned(),
        response_type: "bench/EchoResponse".to_owned(),
    }
}

fn ros2_service() -> ServiceName {
    ServiceName {
        name: "/echo".to_owned(),
        types: ServiceTypes {
            request: "bench::srv::dds_::Echo_Request_".to_owned(),
            response: "bench::srv::dds_::Echo_Response_".to_owned(),
        },
    }
}

fn domain(node: &str) -> Domain {
    Domain::join(&DomainOptions {
        domain: 7,
        networks: vec![std::net::Ipv4Addr::LOCALHOST.into()],
        peers: Vec::new(),
        node: node.into(),
        enclave: None,
    })
    .unwrap()
}

/// Starts a server with a method that returns its argument.
fn opcua_server() -> OpcUaServer {
    let endpoint = "opc.tcp://127.0.0.1:4857/".parse().unwrap();
    let config = ServerConfig::new("urn:ua-bridge:bench:server", "bench", endpoint);
    let server = ServerBuilder::new(config).build().unwrap();
    let argument = Argument {
        name: "bytes".into(),
        data_type: DataTypeId::ByteString.into(),
        value_rank: -1,
        array_dimensions: None,
        description: LocalizedText::null(),
    };
    let spec = MethodSpec {
        node_id: NodeId::new(1, ECHO),
        browse_name: QualifiedName::new(1, "Echo"),
        object: ObjectId::ObjectsFolder.into(),
        arguments: (NodeId::new(1, ECHO + 1), NodeId::new(1, ECHO + 2)),
        takes: vec![argument.clone()],
        gives: vec![argument],
    };
    let echo = method(|request: MethodRequest| Ok(request.arguments));
    server.add_method(spec, echo).unwrap();
    server.start();
    server
}

/// Starts a component, and returns its skill, which takes a text of any length.
async fn skill(cell: &Cell) -> (Child, SkillClient, SkillHandle) {
    let yaml = "{component: echo, application_uri: 'urn:ua-bridge:bench', namespace: 9, skills: [
        {name: Attach, type: AttachToolSkillType, driver: {simulated: {duration: 1 ms}}}]}";
    let endpoint = "opc.tcp://127.0.0.1:4855";
    let component = StartedChild::new("ua-component", &program("ua-component"))
        .args([cell.file("echo.yaml", yaml)])
        .args(["--endpoint", endpoint, "--lds", "none", "--interface", "lo"])
        .start();
    let options = ClientOptions {
        within: SOON,
        ..ClientOptions::default()
    };
    let until = Instant::now() + SOON;
    let client = loop {
        match SkillClient::connect(endpoint, &options).await {
            Ok(client) => break client,
            Err(fault) => assert!(Instant::now() < until, "{fault}"),
        }
    };
    let wanted = ParameterType::own("AttachToolSkillType");
    let found = client.skills_of(&wanted).await.unwrap().remove(0);
    let handle = client.handle(&found);
    (component, client, handle)
}

/// A publisher of values and a subscriber that sends each value back, over UDP on loopback.
struct Echo {
    end: UadpEnd,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Echo {
    fn start() -> Self {
        let sockets = [(), ()].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
        let addresses = sockets.each_ref().map(|one| one.local_addr().unwrap());
        sockets[0].connect(addresses[1]).unwrap();
        sockets[1].connect(addresses[0]).unwrap();
        let [here, there] = sockets.map(UadpEnd::new);
        let stop = Arc::<AtomicBool>::default();
        let stopped = Arc::clone(&stop);
        let mut there = there;
        let thread = std::thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                if let Some(value) = there.receive(LOOK) {
                    there.send(&value);
                }
            }
        });
        Self {
            end: here,
            stop,
            thread: Some(thread),
        }
    }

    fn turn(&mut self, payload: &[u8]) -> Result<(), String> {
        self.end.send(payload);
        let until = Instant::now() + SECOND;
        while Instant::now() < until {
            if let Some(value) = self.end.receive(LOOK) {
                return same_length(value.len(), payload, 0);
            }
        }
        Err("a chunk is lost".to_owned())
    }
}

impl Drop for Echo {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A failed thread has printed its message.
            drop(thread.join());
        }
    }
}

/// An end of UADP over a connected socket.
struct UadpEnd {
    socket: UdpSocket,
    reassembler: Reassembler,
    began: Instant,
    number: u16,
    buffer: Vec<u8>,
}

impl UadpEnd {
    fn new(socket: UdpSocket) -> Self {
        let options = SockRef::from(&socket);
        options.set_recv_buffer_size(4 << 20).unwrap();
        socket.set_read_timeout(Some(LOOK)).unwrap();
        Self {
            socket,
            reassembler: Reassembler::default(),
            began: Instant::now(),
            number: 0,
            buffer: vec![0; 1 << 16],
        }
    }

    /// Sends a value in chunks.
    fn send(&mut self, payload: &[u8]) {
        self.number = self.number.wrapping_add(1);
        let mut encoded = Vec::new();
        let header = NetworkHeader::default();
        let mut message = NetworkMessageEncoder::new(&mut encoded, &header, None).unwrap();
        let header = DataSetHeader {
            sequence_number: Some(self.number),
            ..DataSetHeader::default()
        };
        let mut fields = message.key_frame(&header).unwrap();
        fields.scalar(Scalar::ByteString(Some(payload))).unwrap();
        fields.finish().unwrap();
        message.finish().unwrap();
        let whole = Whole {
            message_type: NetworkMessageType::DataSet,
            writer_id: Some(10),
            message_sequence_number: self.number,
            // Without the byte of flags of the smallest NetworkMessage.
            bytes: &encoded[1..],
        };
        let header = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(2)),
            ..NetworkHeader::default()
        };
        let budget = ChunkBudget {
            network_message: CHUNK,
            trailer: 0,
        };
        let mut chunks = ChunkEncoder::new(&header, &Extras::default(), whole, budget).unwrap();
        let mut datagram = Vec::new();
        let mut sent = 0;
        while let Some(chunk) = chunks.append(&mut datagram, &Extras::default()) {
            let chunk = chunk.unwrap();
            self.socket.send(&datagram[chunk.start..]).unwrap();
            datagram.clear();
            sent += 1;
            if sent % BURST == 0 {
                std::thread::sleep(PAUSE);
            }
        }
    }

    /// Returns the next value; `None` after a while without any.
    fn receive(&mut self, within: Duration) -> Option<Vec<u8>> {
        let until = Instant::now() + within;
        while Instant::now() < until {
            let Ok(length) = self.socket.recv(&mut self.buffer) else {
                continue;
            };
            let now = self.began.elapsed();
            let message = NetworkMessage::decode(&self.buffer[..length]).unwrap();
            // A repeated or incomplete whole is not a value.
            let Ok(Some(whole)) = self.reassembler.receive(&message, now) else {
                continue;
            };
            let message = whole.data_set_message().unwrap();
            let field = message.fields().unwrap().next().unwrap().unwrap();
            if let Field::Scalar(Scalar::ByteString(Some(bytes))) = field {
                return Some(bytes.to_vec());
            }
        }
        None
    }
}

/// A load beside the round trips.
#[derive(Debug, Clone, Copy)]
enum Load {
    None,
    Cores,
    Network,
}

impl Load {
    const fn name(self) -> &'static str {
        match self {
            Self::None => "idle",
            Self::Cores => "both cores busy",
            Self::Network => "45 MB/s of datagrams",
        }
    }

    fn start(self) -> Busy {
        let stop = Arc::<AtomicBool>::default();
        let threads = match self {
            Self::None => Vec::new(),
            Self::Cores => (0..2).map(|_| spin(&stop)).collect(),
            Self::Network => vec![flood(&stop)],
        };
        Busy { stop, threads }
    }
}

/// Starts a thread that keeps a core busy.
fn spin(stop: &Arc<AtomicBool>) -> JoinHandle<()> {
    let stop = Arc::clone(stop);
    std::thread::spawn(move || {
        while !stop.load(Ordering::Relaxed) {
            std::hint::spin_loop();
        }
    })
}

/// Starts a thread that sends 32 datagrams of 1400 B in each millisecond over loopback.
fn flood(stop: &Arc<AtomicBool>) -> JoinHandle<()> {
    let stop = Arc::clone(stop);
    let [from, to] = [(), ()].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
    from.connect(to.local_addr().unwrap()).unwrap();
    to.set_nonblocking(true).unwrap();
    std::thread::spawn(move || {
        let mut datagram = [0; 1400];
        let began = Instant::now();
        for millisecond in 1.. {
            if stop.load(Ordering::Relaxed) {
                return;
            }
            for _ in 0..32 {
                from.send(&datagram).unwrap();
            }
            while to.recv(&mut datagram).is_ok() {}
            let next = began + Duration::from_millis(millisecond);
            std::thread::sleep(next.saturating_duration_since(Instant::now()));
        }
    })
}

/// The threads of a load, which end when it is dropped.
struct Busy {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Drop for Busy {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // It only computes, so it does not fail.
            drop(thread.join());
        }
    }
}

/// The encapsulation header of little-endian CDR.
const CDR: [u8; 4] = [0, 1, 0, 0];
const ECHO: u32 = 500;
/// Bytes of a UADP datagram. Many of them fit into the receive buffer of a socket.
const CHUNK: usize = 8192;
/// Chunks without a pause, which the receive buffer holds.
const BURST: usize = 16;
const PAUSE: Duration = Duration::from_micros(100);
const LOOK: Duration = Duration::from_millis(100);
const SECOND: Duration = Duration::from_secs(1);
const SOON: Duration = Duration::from_secs(30);
const MOST_LOST: usize = 5;
