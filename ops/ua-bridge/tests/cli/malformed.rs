//! Messages about datagrams that are malformed, truncated or secured with other keys.

use crate::program::{file, run, run_on};
use crate::vectors::{DatagramVector, vectors};

/// The vectors that violate the standard, and the message about each.
#[test]
fn malformed_vectors_are_refused_at_the_right_byte() {
    for (name, said) in [
        (
            "asyncua_pubid_uint64",
            "offset 1, PublisherId type: the reserved value 0x6",
        ),
        (
            "asyncua_promoted",
            "offset 14, in the PromotedFields, field 0 (Int32): expected 4 bytes, found 0",
        ),
        // ProbeType 2 requests applications and nothing more.
        (
            "asyncua_discovery_request_metadata",
            "offset 6, in the discovery message, 9 bytes after the end of the message",
        ),
    ] {
        let file = file(&format!("{name}.malformed"), DatagramVector::load(name).hex);
        let ended = run(&["decode", &file]);
        assert_eq!(ended.code, 65, "{name}");
        let first = ended.stderr.lines().next().unwrap();
        assert_eq!(first, format!("{file}: {said}"));
    }
    // The extra byte turns the Count into another DataSetWriterId, and the rest into a chunk.
    let vector = DatagramVector::load("asyncua_chunk");
    assert!(vector.is_malformed());
    let shown = run_on(&["decode", "-"], vector.hex.as_bytes()).quiet();
    assert!(shown.contains("\"dataSetWriterIds\": [1281]"), "{shown}");
    assert_eq!(
        vectors()
            .iter()
            .filter(|vector| vector.is_malformed())
            .count(),
        4
    );
}

#[test]
fn the_bytes_around_a_fault_are_shown_with_a_caret_below_it() {
    let vector = DatagramVector::load("asyncua_pubid_uint64");
    let ended = run_on(&["decode", "-"], vector.hex.as_bytes());
    assert_eq!(
        ended.stderr,
        "stdin: offset 1, PublisherId type: the reserved value 0x6\n\
         \x20 0000  f1 06 05 00 00 00 00 00 00 00 01 64 00 01 01 00\n\
         \x20          ^^\n\
         \x20 0010  01 01 00 0b 00 00 00 00 00 00 04 40\n"
    );
    assert_eq!(ended.stdout, "", "nothing of it was read");
}

/// A key frame of DataSetWriter 10 with an Int32, a String and a Double.
const GOOD: &str =
    "f1 01 0200 01 0500 01 0a00  01 0300  06 2a000000  0c 02000000 6869  0b 0000000000000440";

#[test]
fn a_fault_in_a_field_is_named_with_writer_field_and_type() {
    assert!(!run_on(&["decode", "-"], GOOD.as_bytes()).quiet().is_empty());
    for (good, bad, said) in [
        (
            "0b 0000000000000440",
            "0b 000000",
            "offset 26, in DataSetMessage of DataSetWriterId 10, field 2 (Double): expected 8 bytes, found 3",
        ),
        (
            "0b 0000000000000440",
            "",
            "offset 25, in DataSetMessage of DataSetWriterId 10, field 2 (Variant): expected 1 byte, found 0",
        ),
        (
            "0c 02000000 6869",
            "0c 02000000 c3c3",
            "offset 23, in DataSetMessage of DataSetWriterId 10, field 1 (String): not UTF-8",
        ),
        (
            "0c 02000000 6869",
            "0c 00000080 6869",
            "offset 19, in DataSetMessage of DataSetWriterId 10, field 1 (String): the reserved value 0x80000000",
        ),
        (
            "06 2a000000",
            "26 2a000000",
            "offset 13, in DataSetMessage of DataSetWriterId 10, field 0 (Variant encoding): the reserved value 0x26",
        ),
        (
            "06 2a000000",
            "86 2a000000",
            "offset 14, in DataSetMessage of DataSetWriterId 10, field 0 (array length): 42 does not fit in the bytes left",
        ),
        (
            "01 0300  ",
            "01 ff00  ",
            "offset 11, in DataSetMessage of DataSetWriterId 10, FieldCount: 255 does not fit in the bytes left",
        ),
        (
            "01 0300  ",
            "81 0f 0300  ",
            "offset 11, in DataSetMessage of DataSetWriterId 10, DataSetMessage type: the reserved value 0xf",
        ),
        (
            "01 0300  ",
            "07 0300  ",
            "offset 10, in DataSetMessage of DataSetWriterId 10, field encoding: the reserved value 0x3",
        ),
        (
            "0b 0000000000000440",
            "0b 0000000000000440 0001",
            "offset 34, in DataSetMessage of DataSetWriterId 10, 2 bytes after the end of the message",
        ),
        (
            "01 0a00  ",
            "00  ",
            "offset 7, DataSetMessage Count: the reserved value 0x0",
        ),
        (
            "01 0500 ",
            "11 0500 ",
            "offset 4, GroupFlags: the reserved value 0x10",
        ),
    ] {
        assert!(GOOD.contains(good), "{good}");
        let ended = run_on(&["decode", "-"], GOOD.replacen(good, bad, 1).as_bytes());
        assert_eq!(ended.code, 65, "{bad}");
        let first = ended.stderr.lines().next().unwrap();
        assert_eq!(first, format!("stdin: {said}"));
    }
}

#[test]
fn one_malformed_message_among_several_does_not_hide_the_others() {
    // Three bytes of the Double of the second message are left.
    let hex = DatagramVector::load("wire_two_writers").hex;
    let cut = hex
        .replacen("1c001c00", "1c001200", 1)
        .get(..hex.len() - 20)
        .unwrap()
        .to_owned();
    let ended = run_on(&["decode", "-"], cut.as_bytes());
    assert_eq!(ended.code, 65);
    let said = "offset 59, in DataSetMessage of DataSetWriterId 2, field 1 (Double): expected 8 bytes, found 3";
    assert!(
        ended.stderr.starts_with(&format!("stdin: {said}\n")),
        "{}",
        ended.stderr
    );
    let shown: serde_json::Value = serde_json::from_str(&ended.stdout).unwrap();
    let messages = shown["dataSetMessages"].as_array().unwrap();
    assert_eq!(messages[0]["fields"].as_array().unwrap().len(), 3);
    assert_eq!(messages[0].get("malformed"), None);
    assert_eq!(messages[1]["fields"][0]["value"]["Value"], "cell");
    assert_eq!(messages[1]["fields"].as_array().unwrap().len(), 1);
    assert_eq!(messages[1]["malformed"], said);
    // A malformed message is not encoded as a valid message.
    let again = run_on(&["encode", "-"], ended.stdout.as_bytes());
    assert_eq!(again.code, 65);
    assert!(again.stderr.contains("malformed"), "{}", again.stderr);
}

#[test]
fn sizes_that_reach_too_far_are_named() {
    let hex = DatagramVector::load("wire_two_writers").hex;
    for (sizes, said) in [
        (
            "1c001d00",
            "offset 44, DataSetMessage: expected 29 bytes, found 28",
        ),
        (
            "1c001b00",
            "offset 71, 1 bytes after the end of the message",
        ),
    ] {
        let ended = run_on(
            &["decode", "-"],
            hex.replacen("1c001c00", sizes, 1).as_bytes(),
        );
        assert_eq!(ended.code, 65);
        assert!(ended.stderr.contains(said), "{}", ended.stderr);
    }
}

/// Every prefix of every vector, with all prefixes of a vector in one run.
#[test]
fn where_a_datagram_ends_too_early_the_offset_is_that_of_what_is_cut_off() {
    for vector in vectors() {
        let bytes = vector.hex.len() / 2;
        // The first few hundred prefixes cover all cases.
        let prefixes = (1..bytes.min(300)).map(|end| &vector.hex[..end * 2]);
        let lines = prefixes.collect::<Vec<_>>().join("\n");
        let ended = run_on(&["decode", "--lines", "-"], lines.as_bytes());
        assert!(
            [0, 65].contains(&ended.code),
            "{}: {}",
            vector.name,
            ended.stderr
        );
        let mut faults = 0;
        for said in ended.stderr.lines() {
            let Some(at) = said.strip_prefix("stdin: line ") else {
                continue;
            };
            // Chunks that contradict each other are reported too.
            let Some((line, said)) = at.split_once(": offset ") else {
                continue;
            };
            let (offset, said) = said.split_once(", ").unwrap();
            let (line, offset): (usize, usize) = (line.parse().unwrap(), offset.parse().unwrap());
            // Line n holds the first n bytes.
            assert!(offset <= line, "{}: line {line}: {said}", vector.name);
            if let Some((_, found)) = said.split_once(" bytes, found ") {
                let found: usize = found.parse().unwrap();
                assert!(
                    offset + found <= line,
                    "{}: line {line}: {said}",
                    vector.name
                );
            }
            faults += 1;
        }
        assert!(faults != 0, "{}", vector.name);
    }
}
