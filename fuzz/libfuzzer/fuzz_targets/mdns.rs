//! See `uadp_fuzz::mdns`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| uadp_fuzz::mdns(data));
