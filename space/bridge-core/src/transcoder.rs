//! Conversion of messages that are carried as bytes between ROS 1 and ROS 2.

use std::sync::Arc;

use messages::{
    DefinitionError, Dialect, MessagePlan, MessageType, PlanError, Selection, TypeName,
    TypeRegistry, Wire,
};
use uadp::{
    DataSetHeader, Fields, NetworkHeader, NetworkMessage, NetworkMessageEncoder, Scalar, Variant,
};

use crate::counters::{DropCause, Reason};
use crate::fields::{self, LocalPayload};

/// Converts the bytes of a message of the other ROS version into the local type of the same name.
#[derive(Debug)]
pub(crate) struct Transcoder {
    from: MessagePlan,
    to: MessagePlan,
    namespace: u16,
}

/// The local type cannot be made from messages of the other ROS version.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{there} messages arrive as bytes, but {here} requires {name}: {cause}")]
pub(crate) struct TranscodeError {
    there: &'static str,
    here: &'static str,
    name: TypeName,
    cause: Box<TranscodeCause>,
}

/// Reason of a [`TranscodeError`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
enum TranscodeCause {
    #[error(transparent)]
    Definition(#[from] DefinitionError),
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error("{there} {name} has other fields")]
    Differs { there: &'static str, name: TypeName },
}

impl Transcoder {
    /// Compiles the conversion of messages in the encoding of `origin` to the type `local`.
    ///
    /// # Errors
    /// Names both sides if the other ROS version has no such type among the common interfaces, or
    /// has other fields in it.
    pub(crate) fn compile(
        origin: Dialect,
        local: &Arc<MessageType>,
        namespace: u16,
    ) -> Result<Self, TranscodeError> {
        let name = local.name();
        let (there, here) = (label(origin), label(local.dialect()));
        let why = |cause: TranscodeCause| TranscodeError {
            there,
            here,
            name: name.clone(),
            cause: Box::new(cause),
        };
        let foreign = TypeRegistry::bundle(origin)
            .get(name)
            .map_err(|error| why(error.into()))?;
        let differs = foreign.leaves().len() != local.leaves().len()
            || foreign.leaves().iter().zip(local.leaves()).any(|(a, b)| {
                a.builtin != b.builtin || a.rank != b.rank || !a.path.eq_ignore_ascii_case(&b.path)
            });
        if differs {
            let name = name.clone();
            return Err(why(TranscodeCause::Differs { there, name }));
        }
        let plan = |message: &Arc<MessageType>, wire| {
            MessagePlan::compile(message, &Selection::Whole, wire)
                .map_err(|error| why(error.into()))
        };
        Ok(Self {
            from: plan(&foreign, wire(origin))?,
            to: plan(local, wire(local.dialect()))?,
            namespace,
        })
    }

    /// Appends the local message to `out`; `scratch` holds the intermediate fields.
    pub(crate) fn run(
        &self,
        mut fields: Fields<'_>,
        scratch: &mut Vec<u8>,
        out: &mut Vec<u8>,
    ) -> Result<(), (DropCause, String)> {
        let (Some(Ok(Variant::Scalar(Scalar::ByteString(bytes)))), None) =
            (fields.next(), fields.next())
        else {
            let detail = "expected a message as bytes, which is one ByteString";
            return Err((Reason::Mismatch.into(), detail.to_owned()));
        };
        let too_big = |error: uadp::EncodeError| (Reason::TooBig.into(), error.to_string());
        let mut message = NetworkMessageEncoder::new(scratch, &NetworkHeader::default(), None)
            .map_err(too_big)?;
        let mut frame = message
            .key_frame(&DataSetHeader::default())
            .map_err(too_big)?;
        let payload = LocalPayload::Ros(&self.from, bytes.unwrap_or_default());
        fields::read(&payload, self.namespace, &mut frame)?;
        frame.finish().map_err(too_big)?;
        message.finish().map_err(too_big)?;
        let message = NetworkMessage::decode(scratch).map_err(fields::undecodable)?;
        let message = message.messages().next();
        let fields = message
            .transpose()
            .and_then(|message| message.map(|message| message.fields()).transpose())
            .map_err(fields::undecodable)?;
        fields.map_or(Ok(()), |fields| fields::write(&self.to, fields, out))
    }
}

const fn wire(dialect: Dialect) -> Wire {
    match dialect {
        Dialect::Ros1 => Wire::Ros1,
        Dialect::Ros2 => Wire::Cdr,
    }
}

const fn label(dialect: Dialect) -> &'static str {
    match dialect {
        Dialect::Ros1 => "ROS 1",
        Dialect::Ros2 => "ROS 2",
    }
}
