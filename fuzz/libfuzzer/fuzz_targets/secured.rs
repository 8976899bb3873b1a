//! See `uadp_fuzz::secured`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::secured(data));
