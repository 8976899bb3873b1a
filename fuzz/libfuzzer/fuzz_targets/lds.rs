//! See `uadp_fuzz::lds`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::lds(data));
