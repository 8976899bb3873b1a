//! Vectors that need more than the datagram to be decoded.

/// Vectors without DataSetMessages that can be decoded from the datagram alone, by the reason that
/// `messages` returns. The tests in `chunks.rs`, `discovery.rs` and `security.rs` decode them.
pub(crate) const NOT_READ: &[(&str, &[&str])] = &[
    (
        "a chunk, to be reassembled first",
        &[
            "composite_chunk_0",
            "composite_chunk_1",
            "composite_chunk_2",
        ],
    ),
    (
        "a discovery announcement",
        &[
            "composite_announce_connection",
            "composite_announce_endpoints",
            "composite_announce_metadata",
            "composite_announce_metadata_unknown_writer",
            "composite_announce_writerconfig",
        ],
    ),
    (
        "a discovery probe",
        &[
            "composite_probe_endpoints",
            "composite_probe_metadata",
            "composite_probe_writerconfig",
        ],
    ),
    (
        "secured, to be opened with its keys first",
        &[
            "wire_encrypt_aes128_r0",
            "wire_encrypt_aes128_r1",
            "wire_encrypt_aes128_r2",
            "wire_encrypt_aes256",
            "wire_encrypt_raw_aes128",
            "wire_sign_aes128",
        ],
    ),
];

/// Vectors with fields without types: `raw.rs` decodes them with their DataSetMetaData.
pub(crate) const RAW_DATA: &[&str] = &[
    "asyncua_raw",
    "raw_all_fixed_scalars",
    "raw_array_1d",
    "raw_double",
    "raw_fixed_layout_annexA21",
    "raw_matrix_2d",
    "raw_strings_padded",
    "raw_strings_unpadded",
    "raw_structure_range",
    "wire_annexA21_fixed_r0",
    "wire_annexA21_fixed_r1",
    "wire_raw_mixed",
    "wire_raw_numeric",
];
