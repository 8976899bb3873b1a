//! Captures of UADP datagrams, and their dissection by Wireshark with the dissector of this
//! project.

use std::{fmt::Write as _, fs, path::Path, process::Command};

use serde_json::Value;

use crate::{Cell, GROUP, cell::TSHARK};

const DISSECTOR: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/wireshark/uadp.lua");

/// A capture file in the classic pcap format: IPv4 packets with a UDP datagram each, a millisecond
/// apart.
#[derive(Debug, Clone)]
pub struct CaptureFile {
    port: u16,
    /// The datagrams, each with the number of its captured bytes.
    datagrams: Vec<(Vec<u8>, usize)>,
}

impl CaptureFile {
    /// Returns a capture of these datagrams, sent to [`GROUP`].
    #[must_use]
    pub fn of<D: Into<Vec<u8>>>(datagrams: impl IntoIterator<Item = D>) -> Self {
        Self::cut(datagrams.into_iter().map(|datagram| (datagram, usize::MAX)))
    }

    /// Returns a capture of these datagrams, sent to [`GROUP`], each cut off after the given number
    /// of bytes.
    #[must_use]
    pub fn cut<D: Into<Vec<u8>>>(datagrams: impl IntoIterator<Item = (D, usize)>) -> Self {
        Self {
            port: GROUP.port(),
            datagrams: datagrams
                .into_iter()
                .map(|(datagram, kept)| (datagram.into(), kept))
                .collect(),
        }
    }

    /// Changes the destination port of the datagrams.
    #[must_use]
    pub fn to_port(mut self, port: u16) -> Self {
        self.port = port;
        self
    }

    fn bytes(&self) -> Vec<u8> {
        let mut out = Vec::new();
        for word in [0xA1B2_C3D4_u32, 4 << 16 | 2, 0, 0, 1 << 18, LINKTYPE_RAW] {
            out.extend(word.to_le_bytes());
        }
        for ((datagram, kept), millisecond) in self.datagrams.iter().zip(0_u32..) {
            let packet = self.packet(datagram);
            let whole = u32::try_from(packet.len()).unwrap();
            let kept = packet.len().min(kept.saturating_add(HEADERS));
            let seconds = FIRST + millisecond / 1000;
            let microseconds = millisecond % 1000 * 1000;
            for word in [seconds, microseconds, u32::try_from(kept).unwrap(), whole] {
                out.extend(word.to_le_bytes());
            }
            out.extend(&packet[..kept]);
        }
        out
    }

    /// Returns the IPv4 and UDP headers, without checksums, and the datagram.
    fn packet(&self, datagram: &[u8]) -> Vec<u8> {
        let length = |headers: usize| u16::try_from(datagram.len() + headers).unwrap();
        let mut packet = vec![0x45, 0];
        packet.extend(length(HEADERS).to_be_bytes());
        packet.extend([0, 0, 0, 0, 1, 17, 0, 0, 127, 0, 0, 1]);
        packet.extend(GROUP.ip().octets());
        packet.extend(50_000_u16.to_be_bytes());
        packet.extend(self.port.to_be_bytes());
        packet.extend(length(8).to_be_bytes());
        packet.extend([0, 0]);
        packet.extend(datagram);
        packet
    }
}

/// The link type of packets that start with their IP header.
const LINKTYPE_RAW: u32 = 101;
const HEADERS: usize = 28;
/// Time of the first packet, in seconds since 1970.
const FIRST: u32 = 1_800_000_000;

impl Cell {
    /// Returns tshark's view of each datagram of a capture: the tree under `uadp`, which is empty
    /// where tshark chose another dissector. `args` follow the arguments that are always needed.
    ///
    /// # Panics
    /// Panics if tshark fails or prints a line about Lua, as it does if the dissector has an error.
    #[must_use]
    pub fn dissect(&self, capture: &CaptureFile, args: &[&str]) -> Vec<Dissected> {
        let json = ["-T", "json", "--no-duplicate-keys", "-J", "uadp"];
        let output = self.tshark(capture, &[&json, args].concat());
        let packets: Vec<Value> = serde_json::from_str(&output).unwrap();
        assert_eq!(packets.len(), capture.datagrams.len());
        packets
            .into_iter()
            .map(|mut packet| Dissected(packet["_source"]["layers"]["uadp"].take()))
            .collect()
    }

    /// Returns the Protocol and Info columns of each datagram of a capture, with a space between
    /// them.
    ///
    /// # Panics
    /// Panics as [`dissect`](Self::dissect) does.
    #[must_use]
    pub fn columns(&self, capture: &CaptureFile, args: &[&str]) -> Vec<String> {
        let columns = "-T fields -E separator=/s -e _ws.col.Protocol -e _ws.col.Info";
        let columns: Vec<&str> = columns.split(' ').collect();
        let output = self.tshark(capture, &[&columns, args].concat());
        output.lines().map(str::to_owned).collect()
    }

    /// Returns these fields of each datagram of a capture, separated by tabs; several values of a
    /// field are separated by commas.
    ///
    /// # Panics
    /// Panics as [`dissect`](Self::dissect) does.
    #[must_use]
    pub fn fields(&self, capture: &CaptureFile, fields: &[&str]) -> Vec<String> {
        let mut args = vec!["-T", "fields"];
        for field in fields {
            args.extend(["-e", field]);
        }
        let output = self.tshark(capture, &args);
        output.lines().map(str::to_owned).collect()
    }

    fn tshark(&self, capture: &CaptureFile, args: &[&str]) -> String {
        let path = self.folder().join("datagrams.pcap");
        fs::write(&path, capture.bytes()).unwrap();
        self.tshark_of(&path, args)
    }

    /// Returns the output of tshark for a capture file.
    ///
    /// # Panics
    /// Panics as [`dissect`](Self::dissect) does.
    #[must_use]
    pub fn tshark_of(&self, file: &Path, args: &[&str]) -> String {
        let output = Command::new(TSHARK)
            .arg("-r")
            .arg(file)
            .args(["-X", &format!("lua_script:{DISSECTOR}")])
            .args(args)
            // The configuration of the machine's user and its plugins must not take part.
            .env("WIRESHARK_CONFIG_DIR", self.folder())
            .env("LC_ALL", "C.UTF-8")
            .env("TZ", "UTC")
            .output()
            .unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{errors}");
        assert!(!errors.contains("Lua"), "{errors}");
        let shown = String::from_utf8(output.stdout).unwrap();
        assert!(!shown.contains("Lua Error"), "{shown}");
        shown
    }
}

/// tshark's view of a datagram or of a part of it.
#[derive(Debug, Clone)]
pub struct Dissected(Value);

impl Dissected {
    /// Returns the item with this name directly below this item.
    #[must_use]
    pub fn child(&self, name: &str) -> Option<Self> {
        self.0.get(name).cloned().map(Self)
    }

    /// Returns the values of all fields with this name at any depth, in order, as Wireshark writes
    /// them. An item that has only child items is an empty text.
    #[must_use]
    pub fn all(&self, name: &str) -> Vec<String> {
        let text = |value: &Value| match value {
            Value::String(text) => text.clone(),
            Value::Object(_) => String::new(),
            other => other.to_string(),
        };
        found(&self.0, name).into_iter().map(text).collect()
    }

    /// Returns the value of the field with this name, or `None` without such a field.
    ///
    /// # Panics
    /// Panics if there are several such fields.
    #[must_use]
    pub fn one(&self, name: &str) -> Option<String> {
        let mut all = self.all(name);
        assert!(all.len() <= 1, "{name} is there as {all:?}");
        all.pop()
    }

    /// Returns whether there is a field with this name.
    #[must_use]
    pub fn has(&self, name: &str) -> bool {
        !found(&self.0, name).is_empty()
    }

    /// Returns whether there is a single field with this name, a Boolean that is true.
    #[must_use]
    pub fn is_set(&self, name: &str) -> bool {
        self.one(name).is_some_and(|value| is_true(&value))
    }

    /// Returns the items with this name, each with its child items.
    #[must_use]
    pub fn parts(&self, name: &str) -> Vec<Self> {
        found(&self.0, name)
            .into_iter()
            .map(|value| Self(value.clone()))
            .collect()
    }

    /// Returns the errors that the dissector reports, each as "At byte 12: why".
    #[must_use]
    pub fn expert_infos(&self) -> Vec<String> {
        self.all("_ws.expert.message")
    }
}

/// Returns whether a Boolean is true; its form differs between versions of Wireshark.
#[must_use]
pub fn is_true(value: &str) -> bool {
    matches!(value, "1" | "true" | "True")
}

/// Returns bytes as Wireshark writes them.
#[must_use]
pub fn hex(bytes: &[u8]) -> String {
    let mut out = String::new();
    for byte in bytes {
        let colon = if out.is_empty() { "" } else { ":" };
        write!(out, "{colon}{byte:02x}").unwrap();
    }
    out
}

fn found<'v>(value: &'v Value, name: &str) -> Vec<&'v Value> {
    let mut all = Vec::new();
    collect(value, name, &mut all);
    all
}

fn collect<'v>(value: &'v Value, name: &str, all: &mut Vec<&'v Value>) {
    match value {
        Value::Object(fields) => {
            for (key, inner) in fields {
                match inner {
                    Value::Array(several) if key == name => all.extend(several),
                    one if key == name => all.push(one),
                    other => collect(other, name, all),
                }
            }
        }
        Value::Array(items) => {
            for item in items {
                collect(item, name, all);
            }
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_field_is_found_at_any_depth_alone_and_among_others() {
        let shown = Dissected(
            json!({"a": {"x": "1"}, "b": [{"x": ["2", "3"]}, {"y": "4"}], "y": {"x": "5"}}),
        );
        assert_eq!(shown.all("x"), ["1", "2", "3", "5"]);
        assert_eq!(shown.all("y"), ["4", ""]);
        assert_eq!(shown.parts("y").len(), 2);
        assert_eq!(shown.one("z"), None);
    }

    #[test]
    fn a_capture_keeps_the_length_of_what_it_cuts() {
        let bytes = CaptureFile::cut([(vec![7; 10], 4)]).bytes();
        let (file, packet) = bytes.split_at(24);
        assert_eq!(file[20..], LINKTYPE_RAW.to_le_bytes());
        assert_eq!((packet[8], packet[12]), (32, 38));
        assert_eq!(packet.len(), 16 + 32);
        assert_eq!(packet[44..], [7; 4]);
    }
}
