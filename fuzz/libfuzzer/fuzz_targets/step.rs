//! See `uadp_fuzz::step`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::step(data));
