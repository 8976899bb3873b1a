//! See `uadp_fuzz::rml`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::rml(data));
