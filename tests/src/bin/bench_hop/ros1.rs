//! The ends of ROS 1 paths, by hand with blocking sockets: no library of ours or others' in the measured time.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc;
use std::time::Duration;

use system_tests::{Cell, Child, MASTER, eventually, xml_rpc};

use crate::{PATIENCE, Path, frame, read_frame};

/// A publisher of std_msgs/String with one subscriber.
pub(crate) struct Publisher {
    stream: TcpStream,
}

impl Publisher {
    /// Registers the topic and waits for its subscriber.
    pub(crate) fn new(node: &str, topic: &str) -> Self {
        let data = TcpListener::bind("127.0.0.1:0").unwrap();
        let uri = serve_slave_api(data.local_addr().unwrap().port());
        xml_rpc(
            MASTER,
            "registerPublisher",
            &[node, topic, "std_msgs/String", &uri],
        )
        .unwrap();
        let (found, subscriber) = mpsc::channel();
        let node = node.to_owned();
        std::thread::spawn(move || {
            let (mut stream, _) = data.accept().unwrap();
            stream.set_nodelay(true).unwrap();
            let mut header = Vec::new();
            read_frame(&mut stream, &mut header);
            frame(
                &mut stream,
                &connection_header(&[("callerid", &node), ("latching", "0")]),
            );
            found.send(stream).unwrap();
        });
        let stream = subscriber
            .recv_timeout(Duration::from_secs(20))
            .unwrap_or_else(|_| panic!("nobody subscribed to {topic}"));
        Self { stream }
    }

    pub(crate) fn publish(&mut self, text: &str) {
        write_string(&mut self.stream, text);
    }
}

/// roscpp's `topic_tools relay`.
pub(crate) struct Relay {
    publisher: Publisher,
    subscription: TcpStream,
    buffer: Vec<u8>,
}

impl Relay {
    pub(crate) fn new(cell: &Cell) -> (Self, Child) {
        let child = cell.topic_tools_relay("/bench_in", "/bench_out");
        let mut publisher = Publisher::new("/bench_relay", "/bench_in");
        // The relay advertises its output when it has seen a message.
        let uri = eventually("the relay advertises", Duration::from_secs(20), || {
            publisher.publish("are you there");
            let reply = xml_rpc(
                MASTER,
                "registerSubscriber",
                &[
                    "/bench_end",
                    "/bench_out",
                    "std_msgs/String",
                    "http://127.0.0.1:1/",
                ],
            )?;
            let from = reply.find("http://")?;
            let len = reply[from..].find('<')?;
            Some(reply[from..from + len].to_owned())
        });
        let address = uri.trim_start_matches("http://").trim_end_matches('/');
        let protocols = "<array><data><value><array><data><value><string>TCPROS</string></value>\
                         </data></array></value></data></array>";
        let reply = xml_rpc(
            address,
            "requestTopic",
            &["/bench_end", "/bench_out", protocols],
        )
        .unwrap();
        let port = integers(&reply)
            .into_iter()
            .find(|number| *number > 1)
            .unwrap();
        let mut subscription = TcpStream::connect(("127.0.0.1", port)).unwrap();
        subscription.set_nodelay(true).unwrap();
        subscription.set_read_timeout(Some(PATIENCE)).unwrap();
        let header = [
            ("callerid", "/bench_end"),
            ("topic", "/bench_out"),
            ("tcp_nodelay", "1"),
        ];
        frame(&mut subscription, &connection_header(&header));
        let mut buffer = Vec::new();
        read_frame(&mut subscription, &mut buffer);
        (
            Self {
                publisher,
                subscription,
                buffer,
            },
            child,
        )
    }
}

impl Path for Relay {
    fn name(&self) -> &'static str {
        "roscpp `topic_tools relay`: ROS 1 in, ROS 1 out"
    }

    fn pass(&mut self, text: &str) {
        self.publisher.publish(text);
        loop {
            let length = read_frame(&mut self.subscription, &mut self.buffer);
            if self.buffer[..length].ends_with(text.as_bytes()) {
                return;
            }
        }
    }
}

/// One std_msgs/String frame.
pub(crate) fn write_string(stream: &mut TcpStream, text: &str) {
    let length = u32::try_from(text.len()).unwrap();
    let mut message = (length + 4).to_le_bytes().to_vec();
    message.extend_from_slice(&length.to_le_bytes());
    message.extend_from_slice(text.as_bytes());
    stream.write_all(&message).unwrap();
}

fn connection_header(fields: &[(&str, &str)]) -> Vec<u8> {
    let typed = [
        ("type", "std_msgs/String"),
        ("md5sum", "992ce8a1687cec8c8bd883ec73ca41d1"),
        ("message_definition", "string data\n"),
    ];
    let mut header = Vec::new();
    for (name, value) in fields.iter().chain(&typed) {
        let field = format!("{name}={value}");
        header.extend_from_slice(&u32::try_from(field.len()).unwrap().to_le_bytes());
        header.extend_from_slice(field.as_bytes());
    }
    header
}

/// Answers the calls a publisher gets: where its data is, and yes to all else.
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
            // A caller that has gone will call again.
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

fn integers(xml: &str) -> Vec<u16> {
    xml.split(['<', '>'])
        .filter_map(|part| part.trim().parse().ok())
        .collect()
}
