//! RTDE client, which receives values from the robot and sends values to it.

use std::io;
use std::time::Duration;

use tokio::io::{AsyncWriteExt as _, BufReader};
use tokio::net::TcpStream;
use tokio::time::timeout;

use super::wire::{Kind, Type, VERSION, Value, chunk, next, package};
use crate::modbus::connected;

/// Time limit for a silent robot, which sends 50 times a second.
const ANSWER: Duration = Duration::from_secs(1);

/// A connection with agreed recipes.
#[derive(Debug)]
pub(crate) struct Rtde {
    stream: BufReader<TcpStream>,
    address: String,
    outputs: (u8, Vec<Kind>),
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
    ) -> Result<Self, String> {
        let stream = connected(address).await;
        let stream = stream.map_err(|error| format!("{address} cannot be reached: {error}"))?;
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
    ) -> Result<(), String> {
        let spoken = self.ask(Type::Protocol, &VERSION.to_be_bytes()).await?;
        if spoken != [1] {
            return Err(format!("{} does not speak RTDE {VERSION}", self.address));
        }
        let mut wanted = hertz.to_be_bytes().to_vec();
        wanted.extend(outputs.join(",").bytes());
        let (recipe, kinds) = self.recipe(Type::Outputs, &wanted).await?;
        let known: Option<Vec<Kind>> = kinds.iter().map(|kind| Kind::of(kind)).collect();
        let known = known
            .filter(|known| known.len() == outputs.len())
            .ok_or_else(|| {
                format!(
                    "{} does not tell {}: {}",
                    self.address,
                    outputs.join(","),
                    kinds.join(",")
                )
            })?;
        self.outputs = (recipe, known);
        let (recipe, kinds) = self
            .recipe(Type::Inputs, inputs.join(",").as_bytes())
            .await?;
        if kinds.iter().all(|kind| Kind::of(kind).is_some()) && recipe != 0 {
            self.inputs = Some(recipe);
        }
        self.start().await
    }

    async fn start(&mut self) -> Result<(), String> {
        match self.ask(Type::Start, &[]).await?.as_slice() {
            [1] => Ok(()),
            _ => Err(format!("{} does not begin to tell", self.address)),
        }
    }

    async fn recipe(&mut self, of: Type, wanted: &[u8]) -> Result<(u8, Vec<String>), String> {
        let answer = self.ask(of, wanted).await?;
        let mut rest = answer.as_slice();
        let [recipe] = chunk(&mut rest).ok_or_else(|| self.damaged("a recipe without a number"))?;
        let kinds = String::from_utf8_lossy(rest);
        Ok((recipe, kinds.split(',').map(str::to_owned).collect()))
    }

    /// Sends a request, and returns the next package of that type as its response.
    async fn ask(&mut self, of: Type, body: &[u8]) -> Result<Vec<u8>, String> {
        self.write(of, body).await?;
        self.package(of).await
    }

    /// Returns the next values, in the order of the recipe. Not cancel-safe.
    pub(crate) async fn next(&mut self) -> Result<Vec<Value>, String> {
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
    pub(crate) async fn tell(&mut self, values: &[Value]) -> Result<(), String> {
        let Some(recipe) = self.inputs else {
            return Err(format!(
                "another client of {} tells it that already",
                self.address
            ));
        };
        let mut body = vec![recipe];
        values.iter().for_each(|value| value.put(&mut body));
        self.write(Type::Data, &body).await
    }

    /// Returns the next package of a type. A robot that sends only other types counts as silent,
    /// too.
    async fn package(&mut self, of: Type) -> Result<Vec<u8>, String> {
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
            Ok(Err(error)) => Err(format!("{} is lost: {error}", self.address)),
            Err(_) => Err(format!("{} is silent for {ANSWER:?}", self.address)),
        }
    }

    async fn write(&mut self, of: Type, body: &[u8]) -> Result<(), String> {
        let lost = |error| format!("{} is lost: {error}", self.address);
        let bytes = package(of, body).map_err(lost)?;
        match timeout(ANSWER, self.stream.write_all(&bytes)).await {
            Ok(written) => written.map_err(lost),
            Err(_) => Err(format!("{} takes nothing for {ANSWER:?}", self.address)),
        }
    }

    fn damaged(&self, why: &str) -> String {
        format!("what {} says is damaged: {why}", self.address)
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
        assert_eq!(told, format!("{address} is silent for 1s"));
    }
}
