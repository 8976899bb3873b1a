//! Values of the builtin types of OPC UA as JSON and back, following OPC 10000-6, 5.4.2.
//!
//! Values are converted to JSON by [`show_variant`] and to bytes of UADP by [`variant_bytes`].

mod field_value;
pub mod iso_time;
pub mod node_ids;
pub mod status;
mod structures;
mod values;

pub use field_value::{JsonFieldValue, JsonStatus};
pub use structures::JsonStructure;
pub use values::{
    WrongValue, data_value_bytes, show_data_value, show_scalar, show_variant, variant_bytes,
    write_scalar,
};
