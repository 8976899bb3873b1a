//! See `uadp_fuzz::model`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::model(data));
