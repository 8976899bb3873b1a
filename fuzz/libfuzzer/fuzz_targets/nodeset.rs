//! See `uadp_fuzz::nodeset`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::nodeset(data));
