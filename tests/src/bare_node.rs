//! The ends of ROS 1 paths with blocking sockets, without any ROS library that would count in a
//! measurement.

use std::{
    collections::HashMap,
    io::{self, BufReader, Read, Write},
    net::{TcpListener, TcpStream},
    sync::mpsc,
    time::Duration,
};

use crate::{MASTER, xml_rpc};

/// A ROS 1 node that publishes and subscribes `std_msgs/String`, one connection per topic.
pub struct BareNode {
    name: String,
    uri: String,
    joined: mpsc::Receiver<(String, TcpStream)>,
}

impl BareNode {
    /// Opens the node's two ports. `name` is a resolved name, such as `/bench`.
    ///
    /// # Panics
    /// Panics if no port can be opened.
    #[must_use]
    pub fn start(name: &str) -> Self {
        let data = TcpListener::bind("127.0.0.1:0").unwrap();
        let uri = serve_slave_api(data.local_addr().unwrap().port());
        let (found, joined) = mpsc::channel();
        let node = name.to_owned();
        std::thread::spawn(move || {
            while let Ok((stream, _)) = data.accept() {
                // A peer that closed its connection reconnects by itself. The receiver of the
                // channel may have been dropped.
                if let Ok(subscriber) = welcome(stream, &node)
                    && found.send(subscriber).is_err()
                {
                    return;
                }
            }
        });
        Self {
            name: name.to_owned(),
            uri,
            joined,
        }
    }

    /// Registers the topics, waits until each has a subscriber, and returns their connections in
    /// the same order.
    ///
    /// # Panics
    /// Panics if a topic has no subscriber in time.
    #[must_use]
    pub fn publish(&self, topics: &[String]) -> Vec<TcpStream> {
        self.publish_as(STRING, topics)
    }

    /// Registers topics of a type, as [`publish`](Self::publish) does.
    ///
    /// # Panics
    /// Panics if a topic has no subscriber in time.
    #[must_use]
    pub fn publish_as(&self, message_type: &str, topics: &[String]) -> Vec<TcpStream> {
        for topic in topics {
            self.register("registerPublisher", (topic, message_type))
                .unwrap_or_else(|| panic!("the master does not take {topic}"));
        }
        let mut subscribers = HashMap::new();
        while let Some(missing) = topics
            .iter()
            .find(|topic| !subscribers.contains_key(topic.as_str()))
        {
            let (topic, stream) = self
                .joined
                .recv_timeout(START)
                .unwrap_or_else(|_| panic!("nobody subscribed to {missing}"));
            subscribers.insert(topic, stream);
        }
        let in_order = topics.iter().filter_map(|topic| subscribers.remove(topic));
        in_order.collect()
    }

    /// Connects to the first publisher of a topic. Returns `None` while the master knows no
    /// publisher.
    pub fn subscribe(&self, topic: &str) -> Option<BareSubscription> {
        self.subscribe_as(STRING, topic)
    }

    /// Connects to a topic of a type, as [`subscribe`](Self::subscribe) does.
    pub fn subscribe_as(&self, message_type: &str, topic: &str) -> Option<BareSubscription> {
        let reply = self.register("registerSubscriber", (topic, message_type))?;
        let (_, uri) = reply.split_once("http://")?;
        let address = uri.split(['/', '<']).next()?;
        let protocols = "<array><data><value><array><data><value><string>TCPROS</string></value>\
                         </data></array></value></data></array>";
        let reply = xml_rpc(address, "requestTopic", &[&self.name, topic, protocols])?;
        // [1, message, ["TCPROS", host, port]]
        let port = integers(&reply).find(|number| *number > 1)?;
        let mut stream = TcpStream::connect(("127.0.0.1", port)).ok()?;
        let header = [
            ("callerid", self.name.as_str()),
            ("topic", topic),
            ("tcp_nodelay", "1"),
        ];
        stream
            .write_all(&connection_header(&header, message_type))
            .ok()?;
        let mut subscription = BareSubscription::of(stream);
        subscription.receive().ok()?;
        Some(subscription)
    }

    fn register(&self, method: &str, (topic, message_type): (&str, &str)) -> Option<String> {
        xml_rpc(
            MASTER,
            method,
            &[&self.name, topic, message_type, &self.uri],
        )
    }
}

/// The receiving end of one connection: frames of a 4-byte length and as many bytes.
pub struct BareSubscription {
    stream: BufReader<TcpStream>,
    frame: Vec<u8>,
}

impl BareSubscription {
    /// Reads frames from a connection, waiting for [`PATIENCE`] at most.
    ///
    /// # Panics
    /// Panics if the connection cannot be configured.
    #[must_use]
    pub fn of(stream: TcpStream) -> Self {
        stream.set_nodelay(true).unwrap();
        let this = Self {
            stream: BufReader::with_capacity(READ_AT_ONCE, stream),
            frame: Vec::new(),
        };
        this.wait_at_most(PATIENCE);
        this
    }

    /// Sets the timeout of `receive`.
    ///
    /// # Panics
    /// Panics if the system refuses the timeout.
    pub fn wait_at_most(&self, patience: Duration) {
        self.stream
            .get_ref()
            .set_read_timeout(Some(patience))
            .unwrap();
    }

    /// Lets `receive` wait until the connection ends.
    ///
    /// # Panics
    /// Panics if the system refuses the timeout.
    pub fn wait_without_end(&self) {
        self.stream.get_ref().set_read_timeout(None).unwrap();
    }

    /// Returns the next message: a frame without its length.
    ///
    /// # Errors
    /// Fails if no message arrives in time, and if the connection has ended.
    pub fn receive(&mut self) -> io::Result<&[u8]> {
        self.receive_frame().map(|frame| &frame[4..])
    }

    /// Returns the next frame as received, its length first.
    ///
    /// # Errors
    /// Fails as [`Self::receive`] does.
    pub fn receive_frame(&mut self) -> io::Result<&[u8]> {
        let mut length = [0; 4];
        self.stream.read_exact(&mut length)?;
        let end = usize::try_from(u32::from_le_bytes(length)).map_err(io::Error::other)? + 4;
        if self.frame.len() < end {
            self.frame.resize(end, 0);
        }
        let frame = &mut self.frame[..end];
        frame[..4].copy_from_slice(&length);
        self.stream.read_exact(&mut frame[4..])?;
        Ok(frame)
    }
}

const STRING: &str = "std_msgs/String";

/// Returns a frame with a `std_msgs/String`.
///
/// # Panics
/// Panics if the text is longer than 4 GiB.
#[must_use]
pub fn string_frame(text: &str) -> Vec<u8> {
    let length = u32::try_from(text.len()).unwrap();
    let mut frame = (length + 4).to_le_bytes().to_vec();
    frame.extend_from_slice(&length.to_le_bytes());
    frame.extend_from_slice(text.as_bytes());
    frame
}

/// Does the TCPROS handshake with a subscriber, which may ask for any type.
fn welcome(mut stream: TcpStream, node: &str) -> io::Result<(String, TcpStream)> {
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    let mut length = [0; 4];
    stream.read_exact(&mut length)?;
    let mut header = vec![0; usize::try_from(u32::from_le_bytes(length)).unwrap_or(0)];
    stream.read_exact(&mut header)?;
    let topic = field(&header, "topic")
        .ok_or_else(|| io::Error::other("a header without a topic"))?
        .to_owned();
    // The bridge asks for the type of the mapping.
    let message_type = field(&header, "type").filter(|name| name.contains('/'));
    let own = [("callerid", node), ("latching", "0")];
    stream.write_all(&connection_header(&own, message_type.unwrap_or(STRING)))?;
    Ok((topic, stream))
}

fn connection_header(fields: &[(&str, &str)], message_type: &str) -> Vec<u8> {
    // The peer knows the definition of another type.
    let (sum, definition) = match message_type {
        STRING => ("992ce8a1687cec8c8bd883ec73ca41d1", "string data\n"),
        _ => ("*", ""),
    };
    let typed = [
        ("type", message_type),
        ("md5sum", sum),
        ("message_definition", definition),
    ];
    let length = |text: &[u8]| u32::try_from(text.len()).unwrap().to_le_bytes();
    let mut header = Vec::new();
    for (name, value) in fields.iter().chain(&typed) {
        let field = format!("{name}={value}");
        header.extend_from_slice(&length(field.as_bytes()));
        header.extend_from_slice(field.as_bytes());
    }
    [&length(&header)[..], &header].concat()
}

/// Returns the value of a field of a connection header.
fn field<'a>(mut header: &'a [u8], name: &str) -> Option<&'a str> {
    while let Some((length, rest)) = header.split_first_chunk::<4>() {
        let length = usize::try_from(u32::from_le_bytes(*length)).ok()?;
        let (field, rest) = rest.split_at_checked(length)?;
        match std::str::from_utf8(field).ok()?.split_once('=') {
            Some((found, value)) if found == name => return Some(value),
            _ => header = rest,
        }
    }
    None
}

/// Serves the node's slave API: `requestTopic` returns the data port, and all other calls succeed.
fn serve_slave_api(data_port: u16) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let uri = format!("http://{}/", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        while let Ok((mut stream, _)) = listener.accept() {
            let Some(request) = read_request(&mut stream) else {
                continue;
            };
            let value = if request.contains("requestTopic") {
                format!(
                    "<array><data><value>TCPROS</value><value>127.0.0.1</value><value><i4>{data_port}</i4></value></data></array>"
                )
            } else {
                "<i4>1</i4>".to_owned()
            };
            let body = format!(
                "<?xml version=\"1.0\"?><methodResponse><params><param><value><array><data><value><i4>1</i4></value>\
                 <value>ok</value><value>{value}</value></data></array></value></param></params></methodResponse>"
            );
            let answer = format!(
                "HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nConnection: close\r\nContent-Length: {}\r\n\r\n{body}",
                body.len()
            );
            // A caller that closed its connection calls again.
            drop(stream.write_all(answer.as_bytes()));
        }
    });
    uri
}

fn read_request(stream: &mut TcpStream) -> Option<String> {
    stream.set_read_timeout(Some(PATIENCE)).ok()?;
    let mut request = Vec::new();
    let mut part = [0; 4096];
    loop {
        let length = stream.read(&mut part).ok()?;
        request.extend_from_slice(&part[..length]);
        let text = String::from_utf8_lossy(&request);
        if text.contains("</methodCall>") {
            return Some(text.into_owned());
        }
        if length == 0 {
            return None;
        }
    }
}

fn integers(xml: &str) -> impl Iterator<Item = u16> + '_ {
    xml.split(['<', '>'])
        .filter_map(|part| part.trim().parse().ok())
}

/// The timeout of connections. A message that takes longer is lost.
pub const PATIENCE: Duration = Duration::from_secs(2);
/// The time that Python and a ROS graph need to start on a busy machine.
const START: Duration = Duration::from_secs(30);
/// The size of the read buffer. The rest of a longer message is read in place, without a copy.
const READ_AT_ONCE: usize = 4 * 1024;
