//! Datagrams of 64 KiB that maximize the cost of decoding. Reading them through every accessor
//! allocates nothing, and finds all well-formed values.

use crate::everything;

use allocation_counter::measure;
use everything::read_everything;

const SIZE: usize = 65_536;
/// Maximum nesting depth of values.
const LEVELS: usize = uadp::MAX_NESTING as usize;

const NULL: &[u8] = &[0];
const VARIANT: u8 = 24;
const DATA_VALUE: u8 = 23;
const DIAGNOSTIC_INFO: u8 = 25;
const ARRAY: u8 = 0x80;
const MATRIX: u8 = 0xC0;

/// Returns a key frame of Variants behind the shortest header.
fn key_frame(count: u16, fields: &[u8]) -> Vec<u8> {
    [&[0x01, 0x01], &count.to_le_bytes()[..], fields].concat()
}

/// An array in a Variant.
fn array(element: u8, count: usize, elements: &[u8]) -> Vec<u8> {
    let length = (count as u32).to_le_bytes();
    [&[ARRAY | element], &length[..], elements].concat()
}

fn matrix(element: u8, count: usize, elements: &[u8], dimensions: &[u32]) -> Vec<u8> {
    let mut out = array(element, count, elements);
    *out.first_mut().unwrap() |= MATRIX;
    out.extend((dimensions.len() as u32).to_le_bytes());
    out.extend(dimensions.iter().flat_map(|size| size.to_le_bytes()));
    out
}

/// Nests an array of Variants to the maximum depth with `wrap`, and fills the datagram with its
/// elements.
fn nested(mut wrap: impl FnMut(&[u8]) -> Vec<u8>) -> Vec<u8> {
    let around = (0..LEVELS - 1).fold(array(VARIANT, 0, &[]), |inner, _| wrap(&inner));
    let count = SIZE - key_frame(1, &around).len();
    let core = array(VARIANT, count, &NULL.repeat(count));
    key_frame(1, &(0..LEVELS - 1).fold(core, |inner, _| wrap(&inner)))
}

/// Returns a datagram full of copies of a field.
fn full(field: &[u8]) -> Vec<u8> {
    let count = (SIZE - 4) / field.len();
    key_frame(count as u16, &field.repeat(count))
}

/// Returns a datagram with an array full of copies of an element.
fn full_array(element: u8, bytes: &[u8]) -> Vec<u8> {
    let count = (SIZE - 9) / bytes.len();
    key_frame(1, &array(element, count, &bytes.repeat(count)))
}

/// Checks that `values` values are found in the datagram, without an allocation.
#[track_caller]
fn check(name: &str, datagram: &[u8], values: usize) {
    assert!(
        datagram.len() <= SIZE + 16,
        "{name}: {} bytes",
        datagram.len()
    );
    assert!(
        datagram.len() > SIZE / 2,
        "{name}: {} bytes",
        datagram.len()
    );
    let mut found = 0;
    let allocations = measure(|| found = read_everything(datagram));
    assert!(found >= values, "{name}: {found} of {values} values found");
    assert_eq!(allocations.count_total, 0, "{name}");
}

#[test]
fn values_nested_as_deep_as_may_be_are_read_without_allocating() {
    let many = 60_000;
    check(
        "array of one",
        &nested(|inner| array(VARIANT, 1, inner)),
        many,
    );
    let first = nested(|inner| array(VARIANT, 2, &[inner, NULL].concat()));
    check("first of two", &first, many);
    let last = nested(|inner| array(VARIANT, 2, &[NULL, inner].concat()));
    check("last of two", &last, many);
    let spread = nested(|inner| array(VARIANT, 600, &[inner, &NULL.repeat(599)].concat()));
    check("among nulls", &spread, many);
    let matrices = nested(|inner| matrix(VARIANT, 1, inner, &[1]));
    check("matrix of one", &matrices, many);
    let matrices = nested(|inner| matrix(VARIANT, 2, &[inner, NULL].concat(), &[2, 1]));
    check("matrix of two", &matrices, many);
    let data_values = nested(|inner| [&[DATA_VALUE, 0x03], inner, &[0; 4]].concat());
    check("DataValue", &data_values, many);
    let element = |inner: &[u8]| [&[0x03], inner, &[0; 4], &[0]].concat();
    let data_values = nested(|inner| array(DATA_VALUE, 2, &element(inner)));
    check("array of DataValues", &data_values, many);
}

#[test]
fn many_short_chains_of_values_are_read_without_allocating() {
    let chain = [[0x40].repeat(LEVELS - 1), vec![0]].concat();
    check(
        "DiagnosticInfos",
        &full_array(DIAGNOSTIC_INFO, &chain),
        60_000,
    );
    let field = [&[DIAGNOSTIC_INFO], &chain[..]].concat();
    check("DiagnosticInfo fields", &full(&field), 60_000);
    let chain = [[DATA_VALUE, 0x01].repeat(LEVELS), vec![0]].concat();
    check("DataValue fields", &full(&chain), 300);
    let chain = (0..LEVELS).fold(NULL.to_vec(), |inner, _| array(VARIANT, 1, &inner));
    check("Variant fields", &full(&chain), 130);
    let chain = (0..LEVELS).fold(NULL.to_vec(), |inner, _| {
        array(VARIANT, 2, &[&inner[..], NULL].concat())
    });
    check("Variant pairs", &full(&chain), 10_000);
}

#[test]
fn texts_are_read_without_allocating() {
    let long = |text: &str| {
        let text = text.repeat((SIZE - 600) / text.len());
        [&(text.len() as u32).to_le_bytes(), text.as_bytes()].concat()
    };
    check(
        "long String",
        &key_frame(1, &[&[12], &long("a")[..]].concat()),
        1,
    );
    let umlauts = long("\u{e4}");
    check(
        "long umlauts",
        &key_frame(1, &[&[12], &umlauts[..]].concat()),
        1,
    );
    let chain = [&[0x40].repeat(LEVELS - 1)[..], &[0x10], &umlauts].concat();
    let info = [&[DIAGNOSTIC_INFO], &chain[..]].concat();
    check("text in a DiagnosticInfo", &key_frame(1, &info), LEVELS);
    let text = [&[12], &umlauts[..]].concat();
    let nested = (0..LEVELS).fold(text, |inner, _| array(VARIANT, 1, &inner));
    check("text in Variants", &key_frame(1, &nested), 1);
    let empty = [0; 4];
    for text in [12, 15, 16] {
        check("null texts", &full_array(text, &[0xFF; 4]), 16_000);
        check("empty texts", &full_array(text, &empty), 16_000);
        check(
            "short texts",
            &full_array(text, &[1, 0, 0, 0, b'x']),
            13_000,
        );
    }
}

#[test]
fn arrays_of_the_shortest_elements_are_read_without_allocating() {
    for (element, bytes) in [
        (1, &[0][..]),
        (2, &[0]),
        (3, &[0]),
        (17, &[0, 0]),
        (18, &[0, 0]),
        (20, &[0; 6]),
        (21, &[0]),
        (22, &[0; 3]),
        (DATA_VALUE, &[0]),
        (VARIANT, &[0]),
        (DIAGNOSTIC_INFO, &[0]),
    ] {
        let name = format!("array of type {element}");
        check(
            &name,
            &full_array(element, bytes),
            2 * (SIZE - 16) / bytes.len(),
        );
    }
}

#[test]
fn frames_of_the_most_fields_are_read_without_allocating() {
    check("nulls", &full(&[0]), 65_000);
    check("Bytes", &full(&[3, 7]), 32_000);
    check("empty arrays", &full(&[ARRAY | 3, 0, 0, 0, 0]), 0);
    let count = ((SIZE - 4) as u16).to_le_bytes();
    let data_values = [&[0x01, 0x05], &count[..], &[0].repeat(SIZE - 4)].concat();
    check("empty DataValues", &data_values, 65_000);
    let count = ((SIZE / 3) as u16).to_le_bytes();
    let delta = [&[0x01, 0x81, 0x01], &count[..], &[9, 0, 0].repeat(SIZE / 3)].concat();
    check("changes", &delta, 21_000);
    let promised = [&[0x01, 0x01, 0xFF, 0xFF], &[0; SIZE][..]].concat();
    check("nulls and padding", &promised, 65_000);
}

#[test]
fn the_most_messages_are_read_without_allocating() {
    let header = [&[0x41, 255][..], &[1, 0].repeat(255)].concat();
    let each = (SIZE - header.len() - 510) / 255;
    let message = key_frame((each - 3) as u16, &[0].repeat(each - 3));
    let (_, message) = message.split_first().unwrap();
    let sizes = (each as u16).to_le_bytes().repeat(255);
    let datagram = [&header[..], &sizes, &message.repeat(255)].concat();
    check("255 messages", &datagram, 2 * 255 * (each - 3));
    let reaching = [&header[..], &[0xFF].repeat(510), &message.repeat(255)].concat();
    check("sizes past the end", &reaching, 0);
    let overlapping = [&header[..], &[0, 0x80].repeat(255), &message.repeat(255)].concat();
    check("overlapping sizes", &overlapping, 0);
}

#[test]
fn promoted_fields_are_read_without_allocating() {
    let header = [0x81, 0x80, 0x02, 0xFF, 0xFF];
    let nulls = [&header[..], &[0; 65_535]].concat();
    check("promoted nulls", &nulls, 65_535);
    let nested = nested(|inner| array(VARIANT, 2, &[inner, NULL].concat()));
    let (_, nested) = nested.split_at(4);
    let size = (nested.len() as u16).to_le_bytes();
    let nested = [&header[..3], &size, nested].concat();
    check("promoted nested values", &nested, 60_000);
}

#[test]
fn matrices_of_odd_dimensions_are_read_without_allocating() {
    let room = SIZE / 4 - 8;
    let mut huge = vec![0x7FFF_FFFF; room];
    check("too big", &key_frame(1, &matrix(3, 1, &[7], &huge)), 0);
    *huge.first_mut().unwrap() = 0;
    check("empty", &key_frame(1, &matrix(3, 0, &[], &huge)), 0);
    let ones = vec![1; room];
    check("one", &key_frame(1, &matrix(3, 1, &[7], &ones)), 2);
    check("many", &full(&matrix(3, 1, &[7], &[1])), 2 * 4_000);
    let count = SIZE - 32;
    let nulls = matrix(VARIANT, count, &NULL.repeat(count), &[count as u32, 1]);
    check("nulls", &key_frame(1, &nulls), 2 * count);
}
