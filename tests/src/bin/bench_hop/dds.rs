//! The DDS end of a path: a raw reliable reader that decodes only the text.

use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

use futures_util::StreamExt;
use ros2_node::domain::{Domain, DomainOptions};
use ros2_node::qos::Requested;
use ros2_node::raw::PayloadReader as RawReader;
use tokio::runtime::Runtime;

/// A reader of a topic of std_msgs/String in domain 2.
pub(crate) struct DdsReader {
    // Declared before its domain, which is dropped last.
    reader: RawReader,
    runtime: Runtime,
    _domain: Domain,
}

impl DdsReader {
    pub(crate) fn new(topic: &str) -> Self {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        let options = DomainOptions {
            domain: 2,
            enclave: None,
            networks: vec![IpAddr::V4(Ipv4Addr::LOCALHOST)],
            peers: Vec::new(),
            node: "bench".into(),
        };
        let domain = Domain::join(&options).unwrap();
        let reader = domain
            .reader(
                topic,
                "std_msgs::msg::dds_::String_",
                Requested::from_writers(&[]),
            )
            .unwrap();
        Self {
            reader,
            runtime,
            _domain: domain,
        }
    }

    /// Takes samples until a sample has the text. Returns false after `patience`.
    pub(crate) fn wait_for(&self, text: &str, patience: Duration) -> bool {
        let mut samples = std::pin::pin!(self.reader.as_async_stream());
        self.runtime.block_on(async {
            let found = async {
                while let Some(sample) = samples.next().await {
                    let bytes = sample.unwrap().into_value().into_bytes();
                    // Header, length, text, NUL, padding.
                    if bytes.get(8..8 + text.len()) == Some(text.as_bytes()) {
                        return true;
                    }
                }
                false
            };
            tokio::time::timeout(patience, found).await.unwrap_or(false)
        })
    }
}
