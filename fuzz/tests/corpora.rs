//! Every input that was kept, and every real datagram, through every target.

use std::fs;
use std::path::Path;

use uadp_fuzz::TARGETS;

#[test]
fn every_kept_input_is_taken_without_a_finding() {
    for (name, target) in TARGETS {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("corpus")
            .join(name);
        let mut inputs = 0;
        for entry in
            fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()))
        {
            let path = entry.unwrap().path();
            let input = fs::read(&path).unwrap();
            if let Err(panic) = std::panic::catch_unwind(|| target(&input)) {
                panic!("{}: {panic:?}", path.display());
            }
            inputs += 1;
        }
        assert!(inputs > 10, "{} holds {inputs} inputs", folder.display());
        println!("{name}: {inputs} inputs");
    }
}

#[test]
fn every_real_datagram_is_taken_by_every_target() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../uadp/tests/vectors");
    let mut datagrams = 0;
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension() != Some("hex".as_ref()) {
            continue;
        }
        let hex = fs::read_to_string(&path).unwrap();
        let hex = hex.trim();
        let datagram: Vec<u8> = (0..hex.len() / 2)
            .map(|at| u8::from_str_radix(&hex[2 * at..2 * at + 2], 16).unwrap())
            .collect();
        for (_, target) in TARGETS {
            target(&datagram);
        }
        datagrams += 1;
    }
    assert_eq!(datagrams, 195);
}
