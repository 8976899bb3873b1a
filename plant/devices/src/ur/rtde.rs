//! RTDE client, which receives values from the robot and sends values to it.

use std::io;
use std::time::Duration;

use tokio::io::{AsyncWriteExt as _, BufReader};
use tokio::net::TcpStream;
use tokio::time::timeout;

use super::wire::{RecipeType, RecipeValue, Type, VERSION, chunk, next, package};
use crate::modbus::connected;

/// Time limit for a silent robot, which sends 50 times a second.
const ANSWER: Duration = Duration::from_secs(1);

/// The failure of a connection.
#[derive(Debug, thiserror::Error)]
pub enum RtdeError {
    /// There is no connection.
    #[error("{address} cannot be reached: {error}")]
    Unreachable {
        /// Host and port.
        address: String,
        /// The error of the system.
        error: io::Error,
    },
    /// The robot has another version of the protocol.
    #[error("{address} does not speak RTDE {}", VERSION)]
    Version {
        /// Host and port.
        address: String,
    },
    /// The robot does not have an output, or sends it in an unknown type.
    #[error("{address} does not tell {}: {}", outputs.join(","), kinds.join(","))]
    Outputs {
        /// Host and port.
        address: String,
        /// The names of the requested outputs.
        outputs: Vec<String>,
        /// The types that the robot names for them.
        kinds: Vec<String>,
    },
    /// The robot does not start to send.
    #[error("{address} does not begin to tell")]
    NotStarted {
        /// Host and port.
        address: String,
    },
    /// Another client writes the inputs.
    #[error("another client of {address} tells it that already")]
    InputsTaken {
        /// Host and port.
        address: String,
    },
    /// The connection is lost.
    #[error("{address} is lost: {error}")]
    Lost {
        /// Host and port.
        address: String,
        /// The error of the system.
        error: io::Error,
    },
    /// The robot sends nothing that was requested.
    #[error("{address} is silent for {:?}", ANSWER)]
    Silent {
        /// Host and port.
        address: String,
    },
    /// The robot receives nothing.
    #[error("{address} takes nothing for {:?}", ANSWER)]
    Deaf {
        /// Host and port.
        address: String,
    },
    /// The robot sends data that cannot be read.
    #[error("what {address} says is damaged: {why}")]
    Damaged {
        /// Host and port.
        address: String,
        /// The fault in the data.
        why: String,
    },
}

/// A connection with agreed recipes.
#[derive(Debug)]
pub(crate) struct Rtde {
    stream: BufReader<TcpStream>,
    address: String,
    outputs: (u8, Vec<RecipeType>),
    /// The recipe of the inputs, unless another client has them.
    inputs: Option<u8>,
}

impl Rtde {
    /// Connects, and requests some values at a rate in Hz. Inputs that belong to another client are
    /// not available then.
    pub(crate) async fn open(
        address: &str,
        hertz: f64,
        outputs: &[&str],
        inputs: &[&str],
    ) -> Result<Self, RtdeError> {
        let stream = connected(address).await;
        let stream = stream.map_err(|error| RtdeError::Unreachable {
            address: address.to_owned(),
            error,
        })?;
        let mut rtde = Self {
            stream: BufReader::new(stream),
            address: address.to_owned(),
            outputs: (0, Vec::new()),
            inputs: None,
        };
        rtde.negotiate(hertz, outputs, inputs).await?;
        Ok(rtde)
    }

    async fn negotiate(
        &mut self,
        hertz: f64,
        outputs: &[&str],
        inputs: &[&str],
    ) -> Result<(), RtdeError> {
        let spoken = self.ask(Type::Protocol, &VERSION.to_be_bytes()).await?;
        if spoken != [1] {
            let address = self.address();
            return Err(RtdeError::Version { address });
        }
        let mut wanted = hertz.to_be_bytes().to_vec();
        wanted.extend(outputs.join(",").bytes());
        let (recipe, kinds) = self.recipe(Type::Outputs, &wanted).await?;
        let known: Option<Vec<RecipeType>> =
            kinds.iter().map(|kind| RecipeType::of(kind)).collect();
        let known = known
            .filter(|known| known.len() == outputs.len())
            .ok_or_else(|| RtdeError::Outputs {
                address: self.address(),
                outputs: outputs.iter().map(|name| (*name).to_owned()).collect(),
                kinds,
            })?;
        self.outputs = (recipe, known);
        let (recipe, kinds) = self
            .recipe(Type::Inputs, inputs.join(",").as_bytes())
            .await?;
        if kinds.iter().all(|kind| RecipeType::of(kind).is_some()) && recipe != 0 {
            self.inputs = Some(recipe);
        }
        self.start().await
    }

    async fn start(&mut self) -> Result<(), RtdeError> {
        match self.ask(Type::Start, &[]).await?.as_slice() {
            [1] => Ok(()),
            _ => Err(RtdeError::NotStarted {
                address: self.address(),
            }),
        }
    }

    async fn recipe(&mut self, of: Type, wanted: &[u8]) -> Result<(u8, Vec<String>), RtdeError> {
        let answer = self.ask(of, wanted).await?;
        let mut rest = answer.as_slice();
        let [recipe] = chunk(&mut rest).ok_or_else(|| self.damaged("a recipe without a number"))?;
        let kinds = String::from_utf8_lossy(rest);
        Ok((recipe, kinds.split(',').map(str::to_owned).collect()))
    }

    /// Sends a request, and returns the next package of that type as its response.
    async fn ask(&mut self, of: Type, body: &[u8]) -> Result<Vec<u8>, RtdeError> {
        self.write(of, body).await?;
        self.package(of).await
    }

    /// Returns the next values, in the order of the recipe. Not cancel-safe.
    pub(crate) async fn next(&mut self) -> Result<Vec<RecipeValue>, RtdeError> {
        let body = self.package(Type::Data).await?;
        let mut rest = body.as_slice();
        let (recipe, kinds) = &self.outputs;
        let values = chunk(&mut rest)
            .filter(|[of]: &[u8; 1]| of == recipe)
            .and_then(|_| kinds.iter().map(|kind| kind.take(&mut rest)).collect());
        values.ok_or_else(|| self.damaged("values of another recipe"))
    }

    /// Returns whether the robot accepts inputs from this client.
    pub(crate) fn may_tell(&self) -> bool {
        self.inputs.is_some()
    }

    /// Sends the values of the inputs to the robot.
    pub(crate) async fn tell(&mut self, values: &[RecipeValue]) -> Result<(), RtdeError> {
        let Some(recipe) = self.inputs else {
            let address = self.address();
            return Err(RtdeError::InputsTaken { address });
        };
        let mut body = vec![recipe];
        values.iter().for_each(|value| value.put(&mut body));
        self.write(Type::Data, &body).await
    }

    /// Returns the next package of a type. A robot that sends only other types counts as silent,
    /// too.
    async fn package(&mut self, of: Type) -> Result<Vec<u8>, RtdeError> {
        let wanted = async {
            loop {
                let (said, body) = next(&mut self.stream).await?;
                if said == of {
                    return Ok::<_, io::Error>(body);
                }
            }
        };
        match timeout(ANSWER, wanted).await {
            Ok(Ok(body)) => Ok(body),
            Ok(Err(error)) if error.kind() == io::ErrorKind::InvalidData => {
                Err(self.damaged(&error.to_string()))
            }
            Ok(Err(error)) => Err(self.lost(error)),
            Err(_) => Err(RtdeError::Silent {
                address: self.address(),
            }),
        }
    }

    async fn write(&mut self, of: Type, body: &[u8]) -> Result<(), RtdeError> {
        let bytes = package(of, body).map_err(|error| self.lost(error))?;
        match timeout(ANSWER, self.stream.write_all(&bytes)).await {
            Ok(written) => written.map_err(|error| self.lost(error)),
            Err(_) => Err(RtdeError::Deaf {
                address: self.address(),
            }),
        }
    }

    fn address(&self) -> String {
        self.address.clone()
    }

    fn lost(&self, error: io::Error) -> RtdeError {
        RtdeError::Lost {
            address: self.address(),
            error,
        }
    }

    pub(super) fn damaged(&self, why: &str) -> RtdeError {
        RtdeError::Damaged {
            address: self.address(),
            why: why.to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use tokio::net::TcpListener;

    use super::*;

    #[tokio::test]
    async fn a_robot_that_says_other_things_only_is_not_waited_for() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let talks = async {
            let (mut stream, _) = listener.accept().await.unwrap();
            let text = package(Type::Text, b"still here").unwrap();
            let mut pause = tokio::time::interval(Duration::from_millis(20));
            // Until the other side has disconnected.
            while stream.write_all(&text).await.is_ok() {
                pause.tick().await;
            }
        };
        let asks = async {
            Rtde::open(&address, 50.0, &["actual_TCP_pose"], &[])
                .await
                .unwrap_err()
        };
        let (told, ()) = tokio::join!(asks, talks);
        assert_eq!(told.to_string(), format!("{address} is silent for 1s"));
    }
}
