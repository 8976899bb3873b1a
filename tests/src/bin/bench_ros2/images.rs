//! Images and point clouds through both bridges, compared with Fast DDS and with Cyclone DDS over
//! UDP without a bridge.

use std::io::Write as _;
use std::net::TcpStream;
use std::time::Duration;

use system_tests::{ArrayShape, BareNode, BareSubscription, Cell, Child, eventually, now};

use crate::ends::{LIMIT, Meter, MeterReport, Pacer, START, SendingPace};
use crate::floods::bridges_dropped;

pub(crate) fn measure(cell: &Cell, seconds: u64, in_memory: bool) {
    let carrier = match in_memory {
        true => format!(
            "pubsub: {{shm: {{group: images-{}}}}}\n",
            std::process::id()
        ),
        false => String::new(),
    };
    let mapping = cell.file("images.yaml", &format!("{carrier}{MAPPING}"));
    let mapping = mapping.to_string_lossy();
    let _bridges = [cell.bridge_ros1(&[&mapping]), cell.bridge_ros2(&[&mapping])];
    println!(
        "\nImages and point clouds, {seconds} s of each load, the paths in turn; milliseconds. Readers and writers are reliable, and the \
         sockets of Fast DDS have the default buffers of the system.\n"
    );
    println!(
        "| message | size | rate | path | sent | lost | of these dropped by the bridges | p50 | p99 | p50 / Fast DDS |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
    for (kind, loads) in [(&IMAGE, IMAGES), (&CLOUD, CLOUDS)] {
        let mut paths = Paths::stand(cell, kind);
        for load in loads {
            paths.measure(kind, *load, seconds);
        }
    }
}

/// A message type, with its topics of ROS 1 and of ROS 2.
struct Kind {
    name: &'static str,
    shape: ArrayShape,
    topics: [&'static str; 2],
}

/// A size in bytes and a rate in messages per second.
#[derive(Clone, Copy)]
struct Load {
    size: usize,
    rate: u32,
}

/// The senders and receivers of all paths for a type.
struct Paths {
    fast_dds: (Pacer, Meter),
    cyclone: (Pacer, Meter),
    to_ros2: (Talker, Meter),
    to_ros1: (Pacer, Listener),
}

impl Paths {
    /// Starts the ends, and waits until each path carries messages.
    fn stand(cell: &Cell, kind: &'static Kind) -> Self {
        let [ours, theirs] = kind.topics;
        let reference = format!("{ours}_reference");
        let fast_dds = (
            Pacer::of(kind.peer(cell, "pace", &reference)),
            Meter::of(kind.peer(cell, "meter", &reference)),
        );
        let texts = format!("{ours}_texts");
        let cyclone = (
            Pacer::start(cell, &texts, &["--depth", DEPTH]),
            Meter::start(cell, &texts, &[]),
        );
        let from_ros2 = Pacer::of(kind.peer(cell, "pace", theirs));
        let in_ros2 = Meter::of(kind.peer(cell, "meter", ours));
        let node = BareNode::start(&format!("/bench_{}", kind.name));
        let stream = node.publish_as(kind.shape.message_type, &[ours.to_owned()]);
        let stream = stream.into_iter().next().unwrap();
        let mut to_ros2 = (Talker::of(stream, &kind.shape), in_ros2);
        let mut to_ros1 = (from_ros2, None);
        let hello = Load { size: 64, rate: 50 }.pace(HELLO);
        eventually("ROS 1 to ROS 2 carries", START, || {
            to_ros2.0.send(hello);
            (to_ros2.1.report(hello.ticks).distinct == hello.ticks).then_some(())
        });
        eventually("ROS 2 to ROS 1 carries", START, || {
            to_ros1.0.send(hello);
            let listener = match &mut to_ros1.1 {
                Some(listener) => listener,
                none => none.insert(Listener::of(&node, kind)?),
            };
            (listener.report(hello.ticks).distinct > 0).then_some(())
        });
        let mut to_ros1 = (to_ros1.0, to_ros1.1.unwrap());
        // Messages that were sent before the path was established may still arrive.
        to_ros1.1.report(u64::MAX);
        Self {
            fast_dds,
            cyclone,
            to_ros2,
            to_ros1,
        }
    }

    fn measure(&mut self, kind: &Kind, load: Load, seconds: u64) {
        let pace = load.pace(seconds * u64::from(load.rate));
        let mut reference = None;
        for (path, name) in NAMES.into_iter().enumerate() {
            let dropped = bridges_dropped();
            let mut report = match path {
                0 => passed(&mut self.fast_dds, pace),
                1 => passed(&mut self.cyclone, pace),
                2 => std::thread::scope(|scope| {
                    let (talker, meter) = &mut self.to_ros2;
                    scope.spawn(move || talker.send(pace));
                    meter.report_after(pace, pace.ticks)
                }),
                _ => std::thread::scope(|scope| {
                    let (pacer, listener) = &mut self.to_ros1;
                    scope.spawn(move || pacer.send(pace));
                    listener.report(pace.ticks)
                }),
            };
            let p50 = report.times.at(0.5) / 1000.0;
            #[expect(clippy::cast_precision_loss, reason = "a size for people")]
            let megabytes = load.size as f64 / 1e6;
            println!(
                "| {} | {megabytes} MB | {} Hz | {} | {} | {} | {} | {p50:.1} | {:.1} | {:.2} |",
                kind.name,
                load.rate,
                name,
                pace.ticks,
                pace.ticks - report.distinct.min(pace.ticks),
                bridges_dropped() - dropped,
                report.times.at(0.99) / 1000.0,
                p50 / *reference.get_or_insert(p50),
            );
        }
    }
}

/// Sends and receives at the same time.
fn passed((pacer, meter): &mut (Pacer, Meter), pace: SendingPace) -> MeterReport {
    std::thread::scope(|scope| {
        scope.spawn(move || pacer.send(pace));
        meter.report_after(pace, pace.ticks)
    })
}

impl Load {
    fn pace(self, ticks: u64) -> SendingPace {
        SendingPace {
            ticks,
            size: self.size,
            period: Duration::from_secs(1) / self.rate,
            burst: 0,
            pause: Duration::ZERO,
        }
    }
}

impl Kind {
    fn peer(&self, cell: &Cell, command: &str, topic: &str) -> Child {
        let mut arguments = vec![command, topic, "--limit", LIMIT, "--depth", DEPTH];
        let shape = self.shape.arguments();
        arguments.extend(shape.iter().map(String::as_str));
        cell.fastdds(&arguments)
    }
}

/// A sender of a ROS 1 type.
struct Talker {
    stream: TcpStream,
    shape: &'static ArrayShape,
    number: u64,
    /// The frame of the last message, which the next one of the same size reuses.
    frame: Vec<u8>,
    size: usize,
}

impl Talker {
    const fn of(stream: TcpStream, shape: &'static ArrayShape) -> Self {
        Self {
            stream,
            shape,
            number: 0,
            frame: Vec::new(),
            size: 0,
        }
    }

    fn send(&mut self, pace: SendingPace) {
        if self.size != pace.size {
            self.size = pace.size;
            self.frame = self.shape.frame(pace.size);
        }
        let mut due = now();
        for _ in 0..pace.ticks {
            std::thread::sleep(due.saturating_sub(now()));
            self.shape.stamp(&mut self.frame, self.number);
            self.number += 1;
            self.stream.write_all(&self.frame).unwrap();
            due += pace.period;
        }
    }
}

/// A receiver of a ROS 1 type.
struct Listener {
    subscription: BareSubscription,
    shape: &'static ArrayShape,
    next: u64,
}

impl Listener {
    /// Returns `None` while the topic has no publisher.
    fn of(node: &BareNode, kind: &'static Kind) -> Option<Self> {
        let subscription = node.subscribe_as(kind.shape.message_type, kind.topics[1])?;
        Some(Self {
            subscription,
            shape: &kind.shape,
            next: 0,
        })
    }

    /// Receives this many messages, or until silence.
    fn report(&mut self, expected: u64) -> MeterReport {
        self.subscription.wait_at_most(SILENCE);
        let mut report = MeterReport::default();
        while report.distinct < expected
            && let Ok(message) = self.subscription.receive()
        {
            // A repeated message has an earlier number.
            if let Some(stamp) = self.shape.stamp_of(message)
                && stamp.number >= self.next
            {
                self.next = stamp.number + 1;
                report.distinct += 1;
                report.times.add(now().saturating_sub(stamp.sent));
            }
        }
        report
    }
}

const NAMES: [&str; 4] = [
    "Fast DDS -> Fast DDS",
    "Cyclone DDS -> Cyclone DDS, texts",
    "both bridges, ROS 1 -> UADP -> ROS 2 (Fast DDS)",
    "both bridges, ROS 2 (Fast DDS) -> UADP -> ROS 1",
];

const IMAGES: &[Load] = &[
    Load {
        size: 1_000_000,
        rate: 10,
    },
    Load {
        size: 1_000_000,
        rate: 30,
    },
    Load {
        size: 5_000_000,
        rate: 10,
    },
    Load {
        size: 5_000_000,
        rate: 30,
    },
    Load {
        size: 9_900_000,
        rate: 10,
    },
    Load {
        size: 9_900_000,
        rate: 30,
    },
];
const CLOUDS: &[Load] = &[Load {
    size: 1_000_000,
    rate: 20,
}];

static IMAGE: Kind = Kind {
    name: "Image",
    shape: ArrayShape::IMAGE,
    topics: ["/ua_1_2_10", "/ua_2_2_11"],
};
static CLOUD: Kind = Kind {
    name: "PointCloud2",
    shape: ArrayShape::POINT_CLOUD,
    topics: ["/ua_1_2_12", "/ua_2_2_13"],
};

const MAPPING: &str = "\
spaces:
  - id: 1
  - id: 2
namespaces:
  2: urn:ua-bridge:bench
variables:
  - {node: ns=2;i=10, name: image_there, origin: 1, queue: {drop_oldest: 5}, ros: {topic: /ua_1_2_10, type: sensor_msgs/Image}}
  - {node: ns=2;i=11, name: image_back, origin: 2, queue: {drop_oldest: 5}, ros: {topic: /ua_2_2_11, type: sensor_msgs/Image}}
  - {node: ns=2;i=12, name: cloud_there, origin: 1, queue: {drop_oldest: 5}, ros: {topic: /ua_1_2_12, type: sensor_msgs/PointCloud2}}
  - {node: ns=2;i=13, name: cloud_back, origin: 2, queue: {drop_oldest: 5}, ros: {topic: /ua_2_2_13, type: sensor_msgs/PointCloud2}}
";

/// Depth of the history of the DDS ends.
const DEPTH: &str = "10";
/// The number of small messages by which a path is tried.
const HELLO: u64 = 25;
/// The silence after which no more messages are expected: longer than the repair of a message.
const SILENCE: Duration = Duration::from_secs(5);
