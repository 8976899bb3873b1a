//! Findings of `ua-space doctor` that are provoked by breaking the thing, and their remedies.

use std::fs;
use std::io::{Read as _, Write as _};
use std::net::{TcpListener, UdpSocket};
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde_json::Value;
use system_tests::{Cell, GROUP, HERE, MASTER, Peer, UaSide, eventually, program, xml_rpc};
use uadp::discovery::{
    AnnouncedContent, Announcement, DataSetMetaDataType, FieldMetaData, WireArray,
};
use uadp::{
    BuiltinType, ConfigurationVersion, DataSetHeader, GroupHeader, NetworkHeader,
    NetworkMessageEncoder, NodeId, PublisherId, Scalar, SecurityHeader, StatusCode, Timestamp,
};

use super::{SOON, ua_space, ua_space_anywhere};

/// Runs `ua-space doctor` on loopback with more words, and returns the findings.
fn diagnosis(words: &[&str]) -> Vec<Value> {
    let words = [&["doctor", "--seconds", "0.5"], words].concat();
    findings(&ua_space(&words, &[]).1)
}

/// Like [`diagnosis`], without an interface unless the words name one.
fn diagnosis_anywhere(words: &[&str], variables: &[(&str, &str)]) -> Vec<Value> {
    let words = [&["doctor", "--seconds", "0.3"], words].concat();
    findings(&ua_space_anywhere(&words, variables).1)
}

fn findings(shown: &Value) -> Vec<Value> {
    shown["findings"].as_array().unwrap().clone()
}

/// Asserts that a code is found, with parts of the texts about the fault and about the remedy.
fn assert_found(found: &[Value], code: &str, what: &str, remedy: &str) {
    let mut of_code = found.iter().filter(|one| one["code"] == code);
    let contains = |one: &Value, key: &str, part: &str| {
        let text = one[key].as_str();
        text.is_some_and(|text| text.contains(part))
    };
    assert!(
        of_code.any(|one| contains(one, "what", what) && contains(one, "do", remedy)),
        "{code}: {what:?}, {remedy:?} in {found:#?}"
    );
}

fn assert_absent(found: &[Value], codes: &[&str]) {
    for code in codes {
        assert!(!has(found, code), "{code} in {found:#?}");
    }
}

fn has(found: &[Value], code: &str) -> bool {
    found.iter().any(|one| one["code"] == code)
}

/// Runs a command of the host, such as `ip`.
fn host(words: &[&str]) {
    let output = Command::new(words[0]).args(&words[1..]).output().unwrap();
    assert!(output.status.success(), "{words:?}: {output:?}");
}

#[test]
fn doctor_finds_a_network_that_does_not_carry_the_group() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let alone = diagnosis_anywhere(&[], &[]);
    assert_found(&alone, "D001", "no interface but loopback", "`ip link`");

    let cable = cell.cable();
    cable.lay(HERE);
    let healthy = diagnosis_anywhere(&[], &[]);
    assert_absent(&healthy, &["D001", "D003", "D004", "D070"]);

    let unknown = diagnosis_anywhere(&["--interface", "eth7"], &[]);
    assert_found(&unknown, "D001", "`eth7`", "--interface");

    host(&["ip", "route", "del", "224.0.0.0/4"]);
    let remedy = "`ip route add 239.0.0.0/8 dev INTERFACE`";
    let lost = diagnosis_anywhere(&[], &[]);
    assert_found(&lost, "D004", "no route to 239.192.0.40", remedy);
    assert_absent(&diagnosis(&[]), &["D004"]);
    host(&["ip", "route", "add", "239.0.0.0/8", "dev", "lo"]);
    assert_absent(&diagnosis_anywhere(&[], &[]), &["D001", "D004"]);

    // The kernel discards what it receives from the group, as with a rule of a firewall. `ip` can
    // do that everywhere; nft is not on each machine.
    fs::write("/proc/sys/net/ipv4/conf/lo/disable_policy", "0").unwrap();
    let block = "ip xfrm policy add src 0.0.0.0/0 dst 239.0.0.0/8 dir in action block";
    host(&block.split(' ').collect::<Vec<_>>());
    let what = "multicast does not work on lo (127.0.0.1): nothing came back";
    let remedy = "`ip route get 239.192.0.40`";
    assert_found(&diagnosis(&[]), "D003", what, remedy);
}

#[test]
fn doctor_finds_a_firewall() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    // nft is not on each machine: its output is shown by a script.
    let folder = cell.folder().join("bin");
    fs::create_dir(&folder).unwrap();
    let nft = |rules: &str| {
        let table = format!(
            "table inet filter {{\n\tchain input {{\n\t\ttype filter hook input priority filter; policy accept;\n{rules}\t}}\n\n\tchain cell {{\n\t\tip saddr != 10.0.0.0/8 drop\n\t}}\n\n\tchain forward {{\n\t\ttype filter hook forward priority filter; policy drop;\n\t}}\n}}\n"
        );
        let script = format!("#!/bin/sh\ntest \"$*\" = 'list ruleset' && cat <<'E'\n{table}E\n");
        fs::write(folder.join("nft"), script).unwrap();
        host(&["chmod", "+x", folder.join("nft").to_str().unwrap()]);
        let path = format!("{}:/usr/sbin:/usr/bin:/bin", folder.display());
        diagnosis_anywhere(&["--interface", "lo"], &[("PATH", &path)])
    };
    assert_absent(&nft("\t\tct state invalid drop\n"), &["D070"]);
    let found = nft("\t\tudp dport 4840 jump cell\n");
    let what = "`ip saddr != 10.0.0.0/8 drop`";
    assert_found(&found, "D070", what, "allow UDP port 4840 and IGMP");
}

#[test]
fn doctor_finds_limits_of_the_kernel_and_mends_them() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    // A file in place of a limit that a network cannot set for itself.
    let limit = cell.file("rmem_max", "8388608\n");
    let _rmem = cell.cover("/proc/sys/net/core/rmem_max", &limit);
    let cpu = cell.file("cpuinfo", "flags\t\t: fpu hypervisor\n");
    let _cpu = cell.cover("/proc/cpuinfo", &cpu);
    let poll = cell
        .folder()
        .join("module/haltpoll/parameters/guest_halt_poll_ns");
    fs::create_dir_all(poll.parent().unwrap()).unwrap();
    fs::write(&poll, "200000\n").unwrap();
    let _module = cell.cover("/sys/module", &cell.folder().join("module"));
    let fragments = |low: &str, high: &str| {
        let low = ("/proc/sys/net/ipv4/ipfrag_low_thresh", low);
        let high = ("/proc/sys/net/ipv4/ipfrag_high_thresh", high);
        // The kernel refuses a low mark above the high mark.
        for (path, bytes) in [("/proc/sys/net/ipv4/ipfrag_low_thresh", "0"), high, low] {
            fs::write(path, bytes).unwrap();
        }
    };
    fragments("3145728", "33554432");
    let codes = ["D050", "D052", "D053"];
    assert_absent(&diagnosis(&[]), &codes);

    fs::write(&limit, "212992\n").unwrap();
    fs::write(&poll, "0\n").unwrap();
    fragments("0", "0");
    // There is no room for the fragments of this datagram.
    host(&["ip", "link", "set", "lo", "mtu", "1500"]);
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.send_to(&[0; 20_000], "127.0.0.1:9").unwrap();
    let found = diagnosis(&["--fix"]);
    let remedy = "set net.core.rmem_max to 8388608";
    assert_found(&found, "D050", "212992 bytes", remedy);
    let remedy = "set net.ipv4.ipfrag_high_thresh to 33554432";
    assert_found(&found, "D052", "may take 0 bytes", remedy);
    assert_found(&found, "D052", "reassemblies of fragments failed", remedy);
    let remedy = "echo 200000 > /sys/module/haltpoll/parameters/guest_halt_poll_ns";
    assert_found(&found, "D053", "is 0 on this virtual machine", remedy);

    fs::write(&poll, "200000\n").unwrap();
    let mended = diagnosis(&[]);
    assert_absent(&mended, &["D050", "D053"]);
    // The kernel counts the lost fragments until the host restarts.
    assert_found(
        &mended,
        "D052",
        "33554432 bytes",
        "`nstat -az IpReasmFails`",
    );
    let note = mended.iter().find(|one| one["code"] == "D052").unwrap();
    assert_eq!(note["severity"], "note", "{note}");
}

#[test]
fn doctor_finds_a_socket_that_loses_datagrams() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let holder = UdpSocket::bind("0.0.0.0:4840").unwrap();
    assert_absent(&diagnosis(&[]), &["D006"]);
    let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
    eventually("its buffer is full", SOON, || {
        for _ in 0..100 {
            sender.send_to(&[0; 1000], "127.0.0.1:4840").unwrap();
        }
        (system_tests::overflowed(&holder)? > 0).then_some(())
    });
    let found = diagnosis(&[]);
    let what = "datagrams because its receive buffer was full";
    assert_found(&found, "D006", what, "net.core.rmem_max");
}

#[test]
fn doctor_finds_ros_1_nodes_whose_host_does_not_resolve() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let master = format!("http://{MASTER}");
    let doctor = || {
        let variables = [("ROS_MASTER_URI", master.as_str())];
        diagnosis_anywhere(&["--interface", "lo"], &variables)
    };
    let register = |node: &str, uri: &str| {
        let arguments = [node, "/speed", "std_msgs/Float64", uri];
        let answer = xml_rpc(MASTER, "registerPublisher", &arguments).unwrap();
        assert!(answer.contains("<int>1</int>"), "{answer}");
    };
    register("/here", "http://127.0.0.1:45012/");
    assert_absent(&doctor(), &["D010", "D011"]);
    register("/driver", "http://arm-of-the-cell:45013/");
    let what = "the host `arm-of-the-cell` of ROS 1 node /driver does not resolve";
    let remedy = "add `ADDRESS arm-of-the-cell` to /etc/hosts";
    assert_found(&doctor(), "D011", what, remedy);
    let hosts = cell.file("hosts", "127.0.0.1 localhost\n127.0.0.1 arm-of-the-cell\n");
    let _hosts = cell.cover("/etc/hosts", &hosts);
    assert_absent(&doctor(), &["D010", "D011"]);
}

#[test]
fn doctor_finds_publishers_that_disagree() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let codes = ["D031", "D033", "D040"];
    let mut first = Publisher::new();
    let healthy = while_repeated(
        || {
            first.announce(10, BuiltinType::Double);
            first.send(10, Duration::ZERO);
        },
        || diagnosis(&[]),
    );
    assert_absent(&healthy, &codes);
    assert_absent(&healthy, &["D007"]);
    let (mut second, mut ahead) = (Publisher::new(), Publisher::new());
    let from = ahead.socket.local_addr().unwrap().to_string();
    let found = while_repeated(
        || {
            first.announce(10, BuiltinType::Double);
            first.send(10, Duration::ZERO);
            second.announce(10, BuiltinType::Boolean);
            second.send(10, Duration::ZERO);
            ahead.send(11, Duration::from_secs(3));
        },
        || diagnosis(&[]),
    );
    let what = "(ua_5_2_10) is sent from several addresses";
    assert_found(&found, "D031", what, "its own namespace number");
    let what = "(ua_5_2_10) is announced with different types: Boolean, Double";
    assert_found(&found, "D033", what, "correct the type in the mapping");
    let clock = found.iter().find(|one| one["code"] == "D040").unwrap();
    let what = clock["what"].as_str().unwrap();
    let offset = what.strip_prefix(&format!("the clock of {from} is about "));
    let offset = offset.and_then(|rest| rest.strip_suffix(" ms ahead of the clock of this host"));
    let offset: u32 = offset.unwrap_or_else(|| panic!("{what}")).parse().unwrap();
    assert!((2_500..=3_000).contains(&offset), "{what}");
    assert_found(&found, "D040", "ahead of", "`chronyc tracking`");
}

#[test]
fn doctor_finds_programs_that_drop_values_expire_or_are_old() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let mapping = cell.file(
        "cell.yaml",
        "spaces: [{id: 2}]\nnamespaces: {2: urn:test}\nvariables:\n  - {node: ns=2;i=10, name: Setpoint, \
         origin: 0, ros: {space: 2, topic: /setpoint, type: std_msgs/Float64, field: data}}\n",
    );
    let mapping = mapping.to_str().unwrap();
    let pki = cell.folder().join("pki");
    make_certificate(&pki, 90);
    let _server = cell.ua_server(&[mapping]);
    let _bridge = cell.bridge_ros2(&[mapping]);
    let mut ua_side = UaSide::join();
    let codes = ["D002", "D034", "D036", "D060"];
    assert_absent(&diagnosis(&[]), &codes);

    // The members of the cell use another group.
    let elsewhere = diagnosis(&["--address", "opc.udp://239.192.0.41:4840"]);
    let what = "lo has not joined 239.192.0.41, though ";
    assert_found(&elsewhere, "D002", what, "--address of the cell");

    make_certificate(&pki, 10);
    let old = old_program();
    let found = eventually("the bridge drops a value of the wrong type", SOON, || {
        ua_side.write((0, 2, 10), Scalar::String(Some("fast")));
        let found = diagnosis(&[&old]);
        has(&found, "D034").then_some(found)
    });
    let what = "Setpoint (ua_0_2_10) (mismatch)";
    assert_found(&found, "D034", what, "docs/running.md");
    let what = "0.0.9 of bridge-ros1 (space 1)";
    assert_found(&found, "D036", what, "same version on all hosts");
    let what = "the certificate of ua-server (space 0) expires in ";
    assert_found(&found, "D060", what, "`ua-server renew --pki DIR`");

    let pki = pki.to_str().unwrap();
    let renew = program("ua-server");
    host(&[renew.to_str().unwrap(), "renew", "--pki", pki]);
    assert_absent(&diagnosis(&[]), &["D060"]);
}

/// Makes the certificate of `ua-server`, valid for some days.
fn make_certificate(pki: &Path, days: u32) {
    for folder in ["own", "private"] {
        fs::create_dir_all(pki.join(folder)).unwrap();
    }
    let (key, certificate) = (pki.join("private/private.pem"), pki.join("own/cert.der"));
    let days = days.to_string();
    host(&[
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "rsa:2048",
        "-nodes",
        "-days",
        &days,
        "-subj",
        "/CN=ua-server",
        "-addext",
        "subjectAltName=URI:urn:ua-bridge:server,DNS:localhost,IP:127.0.0.1",
        "-outform",
        "DER",
        "-keyout",
        key.to_str().unwrap(),
        "-out",
        certificate.to_str().unwrap(),
    ]);
}

/// Serves the status of a bridge of an older version, and returns its address.
fn old_program() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let status = r#"{"program":"bridge-ros1","version":"0.0.9","space":1}"#;
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            // A request fits into one segment.
            let _request = stream.read(&mut [0; 4096]).unwrap();
            let answer = format!(
                "HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nConnection: close\r\n\
                 Content-Length: {}\r\n\r\n{status}",
                status.len()
            );
            stream.write_all(answer.as_bytes()).unwrap();
        }
    });
    address
}

/// Repeats `each` every 20 ms on another thread of this network, while `run` runs.
fn while_repeated<T>(mut each: impl FnMut() + Send, run: impl FnOnce() -> T) -> T {
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !is_over.load(Ordering::Relaxed) {
                each();
                std::thread::sleep(Duration::from_millis(20));
            }
        });
        let _end = SetAtEnd(&is_over);
        run()
    })
}

/// Sets a flag when it is dropped, also by a failing assertion.
struct SetAtEnd<'a>(&'a AtomicBool);

impl Drop for SetAtEnd<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// A publisher of space 5 on the codec alone, at an address of its own.
struct Publisher {
    socket: UdpSocket,
    sequence: u16,
}

impl Publisher {
    fn new() -> Self {
        Self {
            socket: UdpSocket::bind("127.0.0.1:0").unwrap(),
            sequence: 0,
        }
    }

    /// Sends a value of `ua_5_2_<id>` by a clock that is ahead of the clock of the host.
    fn send(&mut self, id: u16, ahead: Duration) {
        self.sequence = self.sequence.wrapping_add(1);
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap() + ahead;
        let stamp = Timestamp::from_unix_nanos(i128::try_from(now.as_nanos()).unwrap());
        let header = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(5)),
            group: Some(GroupHeader {
                writer_group_id: Some(2),
                ..GroupHeader::default()
            }),
            timestamp: Some(stamp.time),
            ..NetworkHeader::default()
        };
        let mut datagram = Vec::new();
        let mut message = NetworkMessageEncoder::new(&mut datagram, &header, Some(&[id])).unwrap();
        let header = DataSetHeader {
            sequence_number: Some(self.sequence),
            ..DataSetHeader::default()
        };
        let mut frame = message.key_frame(&header).unwrap();
        frame.scalar(Scalar::Double(1.0)).unwrap();
        frame.finish().unwrap();
        message.finish().unwrap();
        self.socket.send_to(&datagram, GROUP).unwrap();
    }

    /// Announces `ua_5_2_<id>` with one field.
    fn announce(&self, id: u16, builtin: BuiltinType) {
        let name = format!("ua_5_2_{id} Speed");
        let field = FieldMetaData {
            name: Some("value"),
            built_in_type: builtin as u8,
            data_type: NodeId::numeric(0, u32::from(builtin as u8)),
            value_rank: -1,
            ..FieldMetaData::default()
        };
        let fields = [field];
        let announcement = Announcement {
            sequence_number: 0,
            announced: AnnouncedContent::DataSetMetaData {
                writer_id: id,
                meta_data: DataSetMetaDataType {
                    name: Some(&name),
                    fields: WireArray::new(&fields),
                    configuration_version: ConfigurationVersion { major: 1, minor: 1 },
                    ..DataSetMetaDataType::default()
                },
                status: StatusCode::GOOD,
            },
        };
        let mut datagram = Vec::new();
        announcement
            .encode(PublisherId::UInt16(5), SecurityHeader::NONE, &mut datagram)
            .unwrap();
        self.socket.send_to(&datagram, GROUP).unwrap();
    }
}
