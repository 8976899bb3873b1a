//! Tests of the forms of values: those of node-opcua-json 2.186, and of the tables of OPC 10000-6,
//! 5.4 and Annex H.

use uadp::{Nested, Variant};

use super::*;

/// Reads a value; returns it as `json-values` shows it, and the fault that is counted.
fn read(
    json: &Value,
    field: Option<&DataSetField>,
) -> Result<(Value, Option<&'static str>), &'static str> {
    let mut forms = ValueForms::default();
    let mut converted = forms.field(json, field)?;
    converted.status = None;
    let bytes = json_values::variant_bytes(&converted).map_err(|_| "wrong_json_value")?;
    let variant = Nested::<Variant<'_>>::new(&bytes).unwrap().get().unwrap();
    let shown = json_values::show_variant(&variant).unwrap();
    Ok((serde_json::to_value(shown).unwrap(), forms.fault()))
}

fn described(builtin: BuiltinType, data_type: u32, value_rank: i32) -> DataSetField {
    DataSetField {
        name: "v".to_owned(),
        builtin: Some(builtin),
        data_type: Some(data_type),
        value_rank,
        promoted: false,
    }
}

/// Checks that values are read as the standard asks, without a fault.
fn are_standard(values: impl IntoIterator<Item = (Value, Value)>) {
    for (json, wanted) in values {
        assert_eq!(read(&json, None), Ok((wanted, None)), "{json}");
    }
}

/// Checks that values are read, and that the form is counted.
fn are_counted(values: impl IntoIterator<Item = (Value, Value)>) {
    for (json, wanted) in values {
        let fault = Some("nonstandard_json");
        assert_eq!(read(&json, None), Ok((wanted, fault)), "{json}");
    }
}

#[test]
fn a_value_that_the_compact_form_leaves_out_is_the_default() {
    let zero = |kind: u8| json!({"UaType": kind, "Value": 0});
    for kind in 2..=7 {
        are_standard([(json!({ "UaType": kind }), zero(kind))]);
    }
    are_standard([
        (json!({"UaType": 0}), json!({})),
        (json!({"UaType": 1}), json!({"UaType": 1, "Value": false})),
        (json!({"UaType": 8}), json!({"UaType": 8, "Value": "0"})),
        (json!({"UaType": 11}), json!({"UaType": 11, "Value": 0.0})),
        (json!({"UaType": 12}), json!({"UaType": 12, "Value": null})),
        (
            json!({"UaType": 13}),
            json!({"UaType": 13, "Value": "1601-01-01T00:00:00Z"}),
        ),
        (
            json!({"UaType": 14}),
            json!({"UaType": 14, "Value": "00000000-0000-0000-0000-000000000000"}),
        ),
        (json!({"UaType": 17}), json!({"UaType": 17, "Value": "i=0"})),
        (
            json!({"UaType": 21}),
            json!({"UaType": 21, "Value": {"Locale": null, "Text": null}}),
        ),
        (json!({"UaType": 22}), json!({"UaType": 22, "Value": null})),
        (json!({"UaType": 24}), json!({})),
    ]);
    // The metadata describes an array, so the value is a null array.
    let array = described(BuiltinType::Double, 11, 1);
    assert_eq!(
        read(&json!({"UaType": 11}), Some(&array)).unwrap().0,
        json!({"UaType": 11, "Value": [], "NullArray": true})
    );
}

#[test]
fn null_is_the_default_of_the_nullable_types_only() {
    are_standard([
        (
            json!({"UaType": 21, "Value": null}),
            json!({"UaType": 21, "Value": {"Locale": null, "Text": null}}),
        ),
        (
            json!({"UaType": 14, "Value": [null]}),
            json!({"UaType": 14, "Value": ["00000000-0000-0000-0000-000000000000"]}),
        ),
        (
            json!({"UaType": 19, "Value": [null, {}, {"Code": 2_148_139_008_u32}]}),
            json!({"UaType": 19, "Value": [
                {"Code": 0, "Symbol": "Good"},
                {"Code": 0, "Symbol": "Good"},
                {"Code": 2_148_139_008_u32, "Symbol": "BadTimeout"},
            ]}),
        ),
    ]);
    for kind in 1..=9 {
        for json in [
            json!({"UaType": kind, "Value": null}),
            json!({"UaType": kind, "Value": [null]}),
        ] {
            assert_eq!(read(&json, None), Err("wrong_json_value"), "{json}");
        }
    }
}

#[test]
fn null_for_a_number_is_no_number_and_is_counted() {
    are_counted([
        (
            json!({"UaType": 11, "Value": null}),
            json!({"UaType": 11, "Value": "NaN"}),
        ),
        (
            json!({"Type": 10, "Body": [null, 1.5]}),
            json!({"UaType": 10, "Value": ["NaN", 1.5]}),
        ),
    ]);
}

#[test]
fn status_codes_are_objects_or_numbers() {
    let timeout = json!({"Code": 2_148_139_008_u32, "Symbol": "BadTimeout"});
    let wanted = json!({"UaType": 19, "Value": timeout});
    are_standard([
        (wanted.clone(), wanted.clone()),
        (json!({"Type": 19, "Body": 2_148_139_008_u32}), wanted),
        (
            json!({"UaType": 19, "Value": {}}),
            json!({"UaType": 19, "Value": {"Code": 0, "Symbol": "Good"}}),
        ),
    ]);
}

#[test]
fn a_status_is_good_only_if_it_says_so() {
    for (json, number) in [
        (json!(null), Some(0)),
        (json!({}), Some(0)),
        (json!({"Symbol": "Good"}), Some(0)),
        (json!({"Code": 0, "Symbol": "Good"}), Some(0)),
        (json!({"Symbol": "BadDeviceFailure"}), None),
        (json!({"Symbol": "Good", "code": 2_147_483_648_u32}), None),
        (json!({"code": 2_147_483_648_u32}), None),
        (json!({"Code": null}), None),
        (json!({"Code": "0"}), None),
        (json!("BadTimeout"), None),
        (json!("2148139008"), None),
        (json!(-1), None),
    ] {
        assert_eq!(status_number(&json), number, "{json}");
    }
    for wrong in [
        json!({"UaType": 19, "Value": {"Symbol": "BadDeviceFailure"}}),
        json!({"Value": true, "Status": {"code": 2_147_483_648_u32}}),
    ] {
        assert_eq!(read(&wrong, None), Err("wrong_json_value"), "{wrong}");
    }
}

#[test]
fn objects_with_other_keys_are_no_variants_and_no_data_values() {
    let variant = described(BuiltinType::Variant, 24, SCALAR);
    for json in [
        json!({"Type": 1, "Name": "x"}),
        json!({"Type": 1}),
        json!({"Value": true, "Unit": "mm"}),
    ] {
        for field in [None, Some(&variant)] {
            assert_eq!(read(&json, field), Err("undescribed_json"), "{json}");
        }
        let truth = described(BuiltinType::Boolean, 1, SCALAR);
        let read = read(&json, Some(&truth));
        assert_eq!(read, Err("wrong_json_value"), "{json}");
    }
    let times = json!({"Value": true, "ServerTimestamp": "2026-01-02T03:04:05Z"});
    let wanted = json!({"UaType": 1, "Value": true});
    assert_eq!(read(&times, None), Ok((wanted, None)));
    let other = json!({"UaType": 23, "Value": [{"Value": true, "Unit": "mm"}]});
    assert_eq!(read(&other, None), Err("wrong_json_value"));
}

#[test]
fn values_may_be_nested_in_few_levels_only() {
    let nested = |levels: usize| {
        let inner = json!({"UaType": 1, "Value": true});
        (0..levels).fold(inner, |of, _| json!({"UaType": 24, "Value": [of]}))
    };
    assert!(read(&nested(MAX_DEPTH), None).is_ok());
    let deeper = read(&nested(MAX_DEPTH + 1), None);
    assert_eq!(deeper, Err("wrong_json_value"));
    let data_values = (0..=MAX_DEPTH).fold(json!(true), |of, _| json!({ "Value": of }));
    assert_eq!(read(&data_values, None), Err("wrong_json_value"));
    let direct = json!({"UaType": 24, "Value": {"UaType": 1, "Value": true}});
    assert_eq!(read(&direct, None), Err("wrong_json_value"));
}

#[test]
fn times_beyond_the_range_of_the_binary_encoding_are_its_limits() {
    let latest = iso_time::of_date_time(DateTime(i64::MAX));
    for (text, wanted) in [
        ("0001-01-01T00:00:00.000Z", "1601-01-01T00:00:00Z"),
        ("9999-12-31T23:59:59.000Z", latest.as_str()),
        ("9999-12-31T23:59:58Z", "9999-12-31T23:59:58Z"),
        ("2026-01-02T03:04:05.678Z", "2026-01-02T03:04:05.678Z"),
    ] {
        are_standard([(
            json!({"UaType": 13, "Value": text}),
            json!({"UaType": 13, "Value": wanted}),
        )]);
    }
}

#[test]
fn names_have_objects_in_the_old_version_and_texts_in_the_current_version() {
    let node = json!({"UaType": 17, "Value": "ns=1;s=x"});
    are_standard([
        (
            json!({"Type": 17, "Body": {"Id": "x", "IdType": 1, "Namespace": 1}}),
            node,
        ),
        (
            json!({"UaType": 17, "Value": "nsu=urn:judge;s=x"}),
            json!({"UaType": 17, "Value": "s=nsu=urn:judge;s=x"}),
        ),
        (
            json!({"UaType": 18, "Value": "nsu=urn:judge;i=7"}),
            json!({"UaType": 18, "Value": "nsu=urn:judge;i=7"}),
        ),
        (
            json!({"UaType": 20, "Value": "nsu=urn:judge;n"}),
            json!({"UaType": 20, "Value": "0:nsu=urn:judge;n"}),
        ),
        (
            json!({"Type": 20, "Body": {"Name": "n", "Uri": 2}}),
            json!({"UaType": 20, "Value": "2:n"}),
        ),
    ]);
    are_counted([(
        json!({"UaType": 20, "Value": {"Name": "n", "Uri": 2}}),
        json!({"UaType": 20, "Value": "2:n"}),
    )]);
}

#[test]
fn a_localized_text_of_the_old_non_reversible_form_has_no_locale() {
    let wanted = json!({"UaType": 21, "Value": {"Locale": null, "Text": "t"}});
    let field = described(BuiltinType::LocalizedText, 21, SCALAR);
    assert_eq!(read(&json!("t"), Some(&field)), Ok((wanted.clone(), None)));
    are_standard([(
        json!({"UaType": 21, "Value": {"Text": "t"}}),
        wanted.clone(),
    )]);
    are_counted([(json!({"UaType": 21, "Value": "t"}), wanted)]);
}

#[test]
fn structures_are_read_in_every_form_and_their_defaults_are_added() {
    let range = |low: f64, high: f64| {
        let fields = json!({"Low": low, "High": high, "UaTypeId": "i=884"});
        json!({"UaType": 22, "Value": fields})
    };
    let fields = json!({"Low": 1, "High": 2});
    are_standard([
        (
            json!({"UaType": 22, "Value": {"UaTypeId": "i=884", "Low": 1, "High": 2}}),
            range(1.0, 2.0),
        ),
        (
            json!({"UaType": 22, "Value": {"UaTypeId": "i=884", "High": 2}}),
            range(0.0, 2.0),
        ),
        (
            json!({"UaType": 22, "Value": {"UaTypeId": "i=884"}}),
            range(0.0, 0.0),
        ),
        // The NodeId of the type, of the JSON encoding, and of the binary encoding.
        (
            json!({"Type": 22, "Body": {"TypeId": {"Id": 884}, "Body": fields}}),
            range(1.0, 2.0),
        ),
        (
            json!({"Type": 22, "Body": {"TypeId": {"Id": 15375}, "Body": fields}}),
            range(1.0, 2.0),
        ),
        (
            json!({"Type": 22, "Body": {
                "TypeId": {"Id": 886}, "Encoding": 1, "Body": "AAAAAAAA8D8AAAAAAAAAQA==",
            }}),
            range(1.0, 2.0),
        ),
        (
            json!({"UaType": 22, "Value": {}}),
            json!({"UaType": 22, "Value": null}),
        ),
        (
            json!({"UaType": 22, "Value": {"UaTypeId": "i=887", "DisplayName": {"Text": "m"}}}),
            json!({"UaType": 22, "Value": {
                "UaTypeId": "i=887",
                "NamespaceUri": null,
                "UnitId": 0,
                "DisplayName": {"Locale": null, "Text": "m"},
                "Description": {"Locale": null, "Text": null},
            }}),
        ),
    ]);
    are_counted([(
        json!({"UaType": 22, "Value": {"UaTypeId": "i=884", "UaBody": fields}}),
        range(1.0, 2.0),
    )]);
    // The verbose form leaves out the type that the metadata has.
    let field = described(BuiltinType::ExtensionObject, 884, SCALAR);
    assert_eq!(read(&fields, Some(&field)), Ok((range(1.0, 2.0), None)));
    for unknown in [
        json!({"UaType": 22, "Value": {"UaTypeId": "i=296", "Name": "a"}}),
        json!({"UaType": 22, "Value": {"Low": 1, "High": 2}}),
    ] {
        assert_eq!(read(&unknown, None), Err("undescribed_json"), "{unknown}");
    }
    let wrong = json!({"UaType": 22, "Value": {"UaTypeId": "i=884", "Lower": 1}});
    assert_eq!(read(&wrong, None), Err("wrong_json_value"));
}

#[test]
fn a_matrix_has_its_dimensions_under_either_key() {
    let wanted = json!({"UaType": 6, "Value": [1, 2, 3, 4], "Dimensions": [2, 2]});
    are_standard([
        (wanted.clone(), wanted.clone()),
        (
            json!({"Type": 6, "Body": [1, 2, 3, 4], "Dimensions": [2, 2]}),
            wanted.clone(),
        ),
    ]);
    are_counted([(
        json!({"UaType": 6, "Value": [1, 2, 3, 4], "UaDimensions": [2, 2]}),
        wanted,
    )]);
    for dimensions in [
        json!([2, -1, 2]),
        json!([4, "x"]),
        json!([2, 2.5]),
        json!([2, 4_294_967_296_u64]),
        json!(4),
        json!({}),
    ] {
        let json = json!({"UaType": 6, "Value": [1, 2, 3, 4], "Dimensions": dimensions});
        assert_eq!(read(&json, None), Err("malformed_json"), "{json}");
    }
}

#[test]
fn variants_and_data_values_are_read_in_arrays() {
    let elements = json!([{"UaType": 11, "Value": 1.5}, {"UaType": 12, "Value": "x"}, {}]);
    let wanted = json!({"UaType": 24, "Value": elements});
    are_standard([
        (
            json!({"UaType": 24, "Value": [
                {"UaType": 11, "Value": 1.5}, {"UaType": 12, "Value": "x"}, {"UaType": 0},
            ]}),
            wanted.clone(),
        ),
        (
            json!({"Type": 24, "Body": [
                {"Type": 11, "Body": 1.5}, {"Type": 12, "Body": "x"}, null,
            ]}),
            wanted,
        ),
        (
            json!({"Type": 23, "Body": {
                "Value": {"Type": 11, "Body": 1.5}, "Status": 2_148_139_008_u32,
                "SourceTimestamp": "2026-01-02T03:04:05Z", "SourcePicoSeconds": 30,
            }}),
            json!({"UaType": 23, "Value": {
                "UaType": 11, "Value": 1.5,
                "Status": {"Code": 2_148_139_008_u32, "Symbol": "BadTimeout"},
                "SourceTimestamp": "2026-01-02T03:04:05Z", "SourcePicoseconds": 30,
            }}),
        ),
    ]);
    are_counted([(
        json!({"UaType": 23, "Value": {
            "UaType": 11, "Value": 1.5, "StatusCode": {"Code": 2_148_139_008_u32},
        }}),
        json!({"UaType": 23, "Value": {
            "UaType": 11, "Value": 1.5,
            "Status": {"Code": 2_148_139_008_u32, "Symbol": "BadTimeout"},
        }}),
    )]);
}

#[test]
fn members_of_a_diagnostic_info_may_be_null() {
    are_standard([(
        json!({"UaType": 25, "Value": {
            "SymbolicId": 3, "NamespaceUri": -1, "AdditionalInfo": "x",
            "InnerStatusCode": {"Code": 2_148_139_008_u32, "Symbol": "BadTimeout"},
            "InnerDiagnosticInfo": null,
        }}),
        json!({"UaType": 25, "Value": {
            "SymbolicId": 3, "NamespaceUri": -1, "AdditionalInfo": "x",
            "InnerStatusCode": {"Code": 2_148_139_008_u32, "Symbol": "BadTimeout"},
        }}),
    )]);
}
