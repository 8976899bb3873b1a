//! The path through roscpp, from ROS 1 to ROS 1.

use std::io::Write;
use std::net::TcpStream;
use std::time::Duration;

use system_tests::{BareNode, BareSubscription, Cell, Child, eventually, string_frame};

use crate::Path;

/// roscpp's `topic_tools relay`.
pub(crate) struct TopicToolsRelay {
    publisher: TcpStream,
    subscription: BareSubscription,
}

impl TopicToolsRelay {
    pub(crate) fn new(cell: &Cell) -> (Self, Child) {
        let child = cell.topic_tools_relay("/bench_in", "/bench_out");
        let node = BareNode::start("/bench_relay");
        let mut publisher = node.publish(&["/bench_in".to_owned()]).remove(0);
        // The relay advertises its output when it has received a message.
        let subscription = eventually("the relay advertises", Duration::from_secs(20), || {
            publisher.write_all(&string_frame("are you there")).unwrap();
            node.subscribe("/bench_out")
        });
        let relay = Self {
            publisher,
            subscription,
        };
        (relay, child)
    }
}

impl Path for TopicToolsRelay {
    fn name(&self) -> &'static str {
        "roscpp `topic_tools relay`: ROS 1 in, ROS 1 out"
    }

    fn pass(&mut self, text: &str) {
        self.publisher.write_all(&string_frame(text)).unwrap();
        while !self
            .subscription
            .receive()
            .unwrap()
            .ends_with(text.as_bytes())
        {}
    }
}
