//! Measures the cost of many topics in a process. The counts of threads, memory and files are
//! printed to standard output, with a JSON object per line.
//!
//! `crowd steady N` publishes N topics in a node, subscribes to them in another node, and prints
//! the cost once all are connected. `crowd churn N ROUNDS` repeatedly creates and drops N
//! publishers of `/crowd/out_*` and N subscribers of `/crowd/in_*`; other nodes have to subscribe
//! to the outputs and publish the inputs. It prints the cost after a tenth of the rounds, when all
//! pools are filled, and at the end.

#![expect(clippy::print_stdout, reason = "what it measures is its output")]

use std::time::{Duration, Instant};

use bytes::Bytes;
use tcpros::{
    Inbox, InboxEvent, MasterState, Node, NodeOptions, Publisher, PublisherOptions, RequestedType,
    SubscriberOptions, Subscription, TopicType,
};
use tokio::time::{sleep, timeout};

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .init();
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words.as_slice() {
        ["steady", topics] => steady(topics.parse()?).await,
        ["churn", topics, rounds] => churn(topics.parse()?, rounds.parse()?).await,
        _ => Err("crowd steady N | crowd churn N ROUNDS".into()),
    }
}

async fn steady(topics: usize) -> Result<(), Box<dyn std::error::Error>> {
    let started = now();
    let talker = Node::start(NodeOptions::from_env("crowd_talker"))?;
    let listener = Node::start(NodeOptions::from_env("crowd_listener"))?;
    let mut inbox = Inbox::new();
    let names = names("topic", topics);
    let subscriptions = subscribe(&listener, &names, &inbox)?;
    let publishers = advertise(&talker, &names)?;
    within("connections", async {
        while !publishers.iter().all(|p| p.subscribers() == 1) {
            sleep(POLL).await;
        }
    })
    .await?;
    for node in [&talker, &listener] {
        let mut state = node.master_state();
        let registered = state.wait_for(|s| *s == MasterState::Registered);
        drop(within("the master", registered).await??);
    }
    let ready = started.elapsed();
    for publisher in &publishers {
        // A lost subscriber shows in the count of received messages.
        let _published = publisher.publish(content());
    }
    within("messages", async {
        let mut heard = 0;
        while heard < topics {
            if let (_, InboxEvent::Message(_)) = inbox.recv().await {
                heard += 1;
            }
        }
    })
    .await?;
    say("steady", ready)?;
    drop((subscriptions, publishers));
    talker.shutdown().await;
    listener.shutdown().await;
    Ok(())
}

async fn churn(topics: usize, rounds: usize) -> Result<(), Box<dyn std::error::Error>> {
    let started = now();
    let node = Node::start(NodeOptions::from_env("crowd"))?;
    let (inputs, outputs) = (names("in", topics), names("out", topics));
    let warm = rounds / 10;
    for round in 1..=rounds {
        let mut inbox = Inbox::new();
        let subscriptions = subscribe(&node, &inputs, &inbox)?;
        let publishers = advertise(&node, &outputs)?;
        within("the other nodes", async {
            let mut silent: std::collections::BTreeSet<usize> = (0..topics).collect();
            while !silent.is_empty() {
                if let (index, InboxEvent::Message(_)) = inbox.recv().await {
                    silent.remove(&index);
                }
            }
            while !publishers.iter().all(|p| p.subscribers() > 0) {
                sleep(POLL).await;
            }
        })
        .await?;
        for publisher in &publishers {
            // The receivers are of no interest here.
            let _published = publisher.publish(content());
        }
        drop((subscriptions, publishers));
        if round == warm || round == rounds {
            within("files to be closed", settled()).await??;
            say(
                if round == warm { "warm" } else { "end" },
                started.elapsed(),
            )?;
        }
    }
    node.shutdown().await;
    Ok(())
}

fn names(of: &str, count: usize) -> Vec<String> {
    (0..count).map(|n| format!("/crowd/{of}_{n}")).collect()
}

fn advertise(node: &Node, names: &[String]) -> Result<Vec<Publisher>, tcpros::NodeError> {
    let string = TopicType {
        name: "std_msgs/String".to_owned(),
        md5sum: "992ce8a1687cec8c8bd883ec73ca41d1".to_owned(),
        definition: "string data\n".to_owned(),
    };
    let options = PublisherOptions::default();
    names
        .iter()
        .map(|name| node.advertise(name, string.clone(), options))
        .collect()
}

fn subscribe(
    node: &Node,
    names: &[String],
    inbox: &Inbox<usize>,
) -> Result<Vec<Subscription>, tcpros::NodeError> {
    let options = SubscriberOptions::default();
    names
        .iter()
        .enumerate()
        .map(|(index, name)| node.subscribe(name, RequestedType::default(), options, index, inbox))
        .collect()
}

/// A serialized `std_msgs/String`.
const fn content() -> Bytes {
    Bytes::from_static(b"\x02\0\0\0hi")
}

/// Waits with a time limit, so that missing connections are reported as a failure.
async fn within<T>(what: &str, wait: impl Future<Output = T>) -> Result<T, String> {
    let done = timeout(LONGEST_WAIT, wait).await;
    done.map_err(|_| format!("waited {LONGEST_WAIT:?} for {what}"))
}

/// Waits until the number of open files is stable.
async fn settled() -> std::io::Result<()> {
    let mut before = files()?;
    let mut quiet = 0;
    while quiet < 20 {
        sleep(POLL).await;
        let open = files()?;
        quiet = if open <= before { quiet + 1 } else { 0 };
        before = open;
    }
    Ok(())
}

fn say(what: &str, after: Duration) -> Result<(), Box<dyn std::error::Error>> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let field = |name: &str| {
        let line = status.lines().find_map(|line| line.strip_prefix(name));
        line.and_then(|rest| rest.split_whitespace().next())
            .map(str::to_owned)
            .ok_or_else(|| format!("/proc/self/status has no {name}"))
    };
    println!(
        "{{\"{what}\": true, \"threads\": {}, \"rss_kib\": {}, \"files\": {}, \"after_ms\": {}}}",
        field("Threads:")?,
        field("VmRSS:")?,
        files()?,
        after.as_millis()
    );
    Ok(())
}

fn files() -> std::io::Result<usize> {
    Ok(std::fs::read_dir("/proc/self/fd")?.count())
}

#[expect(
    clippy::disallowed_methods,
    reason = "how long it takes is what it measures"
)]
fn now() -> Instant {
    Instant::now()
}

const LONGEST_WAIT: Duration = Duration::from_secs(120);
const POLL: Duration = Duration::from_millis(10);
