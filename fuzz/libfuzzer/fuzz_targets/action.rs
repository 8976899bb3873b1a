//! See `uadp_fuzz::action`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::action(data));
