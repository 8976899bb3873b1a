//! See `uadp_fuzz::chunks`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::chunks(data));
