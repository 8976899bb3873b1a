//! Names of StatusCodes of values.

use uadp::StatusCode;

/// Returns the name of a code without info bits; `None` for codes that values rarely have.
#[must_use]
pub fn symbol(status: StatusCode) -> Option<&'static str> {
    let known = |entry: &&(u32, &'static str)| entry.0 == status.0;
    KNOWN.iter().find(known).map(|(_, symbol)| *symbol)
}

/// StatusCodes of OPC 10000-6, Annex A.
const KNOWN: [(u32, &str); 46] = [
    (0x0000_0000, "Good"),
    (0x0030_0000, "GoodClamped"),
    (0x0096_0000, "GoodLocalOverride"),
    (0x00A5_0000, "GoodNoData"),
    (0x4000_0000, "Uncertain"),
    (0x408F_0000, "UncertainNoCommunicationLastUsableValue"),
    (0x4090_0000, "UncertainLastUsableValue"),
    (0x4091_0000, "UncertainSubstituteValue"),
    (0x4092_0000, "UncertainInitialValue"),
    (0x4093_0000, "UncertainSensorNotAccurate"),
    (0x4094_0000, "UncertainEngineeringUnitsExceeded"),
    (0x4095_0000, "UncertainSubNormal"),
    (0x8000_0000, "Bad"),
    (0x8001_0000, "BadUnexpectedError"),
    (0x8002_0000, "BadInternalError"),
    (0x8003_0000, "BadOutOfMemory"),
    (0x8004_0000, "BadResourceUnavailable"),
    (0x8005_0000, "BadCommunicationError"),
    (0x8006_0000, "BadEncodingError"),
    (0x8007_0000, "BadDecodingError"),
    (0x800A_0000, "BadTimeout"),
    (0x800C_0000, "BadShutdown"),
    (0x800D_0000, "BadServerNotConnected"),
    (0x801F_0000, "BadUserAccessDenied"),
    (0x8031_0000, "BadNoCommunication"),
    (0x8032_0000, "BadWaitingForInitialData"),
    (0x8033_0000, "BadNodeIdInvalid"),
    (0x8034_0000, "BadNodeIdUnknown"),
    (0x803A_0000, "BadNotReadable"),
    (0x803B_0000, "BadNotWritable"),
    (0x803C_0000, "BadOutOfRange"),
    (0x803D_0000, "BadNotSupported"),
    (0x803E_0000, "BadNotFound"),
    (0x8074_0000, "BadTypeMismatch"),
    (0x8089_0000, "BadConfigurationError"),
    (0x808A_0000, "BadNotConnected"),
    (0x808B_0000, "BadDeviceFailure"),
    (0x808C_0000, "BadSensorFailure"),
    (0x808D_0000, "BadOutOfService"),
    (0x809B_0000, "BadNoData"),
    (0x809D_0000, "BadDataLost"),
    (0x809E_0000, "BadDataUnavailable"),
    (0x80AB_0000, "BadInvalidArgument"),
    (0x80AF_0000, "BadInvalidState"),
    (0x80B1_0000, "BadNoDataAvailable"),
    (0x80BF_0000, "BadStateNotActive"),
];
