//! See `uadp_fuzz::message`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::message(data));
