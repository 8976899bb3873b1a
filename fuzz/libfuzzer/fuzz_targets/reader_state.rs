//! See `uadp_fuzz::reader_state`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::reader_state(data));
