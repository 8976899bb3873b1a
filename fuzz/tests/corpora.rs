//! Runs every target with all stored inputs and all recorded datagrams.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use uadp_fuzz::TARGETS;

/// Returns the inputs of a target. Mapping documents are stored with the crate that parses them.
fn inputs(name: &str) -> Vec<PathBuf> {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folders = match name {
        "mapping" => vec![here.join("../mappings/tests/bad"), here.join("../mappings")],
        _ => vec![here.join("corpus").join(name)],
    };
    let files = |folder: &PathBuf| {
        fs::read_dir(folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()))
    };
    let mut found: Vec<PathBuf> = folders
        .iter()
        .flat_map(files)
        .map(|entry| entry.unwrap().path())
        .filter(|path| name != "mapping" || path.extension() == Some("yaml".as_ref()))
        .collect();
    found.sort();
    found
}

#[test]
fn every_kept_input_is_taken_without_a_finding() {
    for (name, target) in TARGETS {
        let inputs = inputs(name);
        for path in &inputs {
            let input = fs::read(path).unwrap();
            if let Err(panic) = std::panic::catch_unwind(|| target(&input)) {
                panic!("{}: {panic:?}", path.display());
            }
        }
        let count = inputs.len();
        assert!(count > 10, "{name} has {count} inputs");
        println!("{name}: {count} inputs");
    }
}

/// Random numbers from a seed (Marsaglia's xorshift64), so every run tries the same inputs.
struct Chance(u64);

impl Chance {
    fn below(&mut self, bound: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        usize::try_from(self.0 >> 1).unwrap() % bound.max(1)
    }

    /// Applies a change that typically breaks parsers: a byte, a length, a piece that is removed,
    /// duplicated or taken from another input.
    fn change(&mut self, input: &mut Vec<u8>, other: &[u8]) {
        let at = self.below(input.len() + 1);
        let piece = at..(at + self.below(16)).min(input.len());
        match self.below(7) {
            0 => {
                if let Some(byte) = input.get_mut(at) {
                    *byte ^= 1 << self.below(8);
                }
            }
            1 => input.insert(at, u8::try_from(self.below(256)).unwrap()),
            2 => {
                const LENGTHS: [u32; 6] = [0, 1, 0x7F, 0xFFFF, 0x7FFF_FFFF, u32::MAX];
                let length = LENGTHS[self.below(LENGTHS.len())].to_le_bytes();
                for (byte, to) in input.iter_mut().skip(at).zip(length) {
                    *byte = to;
                }
            }
            3 => drop(input.drain(piece)),
            4 => {
                let doubled = input[piece].to_vec();
                drop(input.splice(at..at, doubled));
            }
            5 => {
                let from = self.below(other.len() + 1);
                let to = (from + self.below(32)).min(other.len());
                drop(input.splice(at..at, other[from..to].iter().copied()));
            }
            _ => input.truncate(at),
        }
    }
}

/// Returns the largest memory of this process so far in MiB, as the kernel counts it.
fn peak_memory() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let mut lines = status.lines();
    let peak = lines.find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    let kib: u64 = peak.trim().trim_end_matches(" kB").parse().unwrap();
    kib / 1024
}

/// Returns the time, by which the duration of a target is printed.
#[expect(clippy::disallowed_methods, reason = "prints durations only")]
fn now() -> Instant {
    Instant::now()
}

/// Runs `UA_FUZZ_CHANGES` changed inputs of each target, by default 2000. `UA_FUZZ_SEED` selects
/// the inputs, and `UA_FUZZ_TARGETS` the targets, separated by commas. No target may need more than
/// `UA_FUZZ_MEMORY` MiB, by default 2000.
#[test]
fn changed_inputs_are_taken_without_a_finding() {
    let number = |variable: &str, default: u64| {
        std::env::var(variable).map_or(default, |text| text.parse().unwrap())
    };
    let (changes, seed) = (number("UA_FUZZ_CHANGES", 2_000), number("UA_FUZZ_SEED", 1));
    let memory = number("UA_FUZZ_MEMORY", 2_000);
    let only = std::env::var("UA_FUZZ_TARGETS").ok();
    let chosen = |name: &str| {
        only.as_ref()
            .is_none_or(|only| only.split(',').any(|one| one == name))
    };
    for (name, target) in TARGETS.iter().filter(|(name, _)| chosen(name)) {
        let kept: Vec<Vec<u8>> = inputs(name)
            .iter()
            .map(|path| fs::read(path).unwrap())
            .filter(|input| input.len() <= 4096)
            .collect();
        let began = now();
        let mut chance = Chance(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
        for _ in 0..changes {
            let mut input = kept[chance.below(kept.len())].clone();
            for _ in 0..=chance.below(4) {
                let other = chance.below(kept.len());
                chance.change(&mut input, &kept[other]);
            }
            if let Err(panic) = std::panic::catch_unwind(|| target(&input)) {
                panic!("{name}: {panic:?} of {input:02x?}");
            }
        }
        let (time, peak) = (began.elapsed().as_secs_f64(), peak_memory());
        println!("{name}: {changes} changed inputs in {time:.1} s, at most {peak} MiB of memory");
        assert!(
            peak <= memory,
            "{name} needed {peak} MiB, more than {memory}"
        );
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
