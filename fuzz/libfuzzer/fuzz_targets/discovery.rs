//! See `uadp_fuzz::discovery`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::discovery(data));
