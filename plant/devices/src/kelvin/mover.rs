//! The robot that moves the flange.

use std::sync::Arc;
use std::time::Duration;

use skills::{
    ParameterType, PartEnd, PartnerError, PeerAccess, RunnableSkill, SkillClient, SkillFault,
    SkillValue, Work, run_part,
};

use super::error::KelvinError;
use super::{Mover, Way};

/// The skills of the robot, and the connection to them.
pub(super) struct ConnectedMover {
    ptp: Arc<dyn RunnableSkill>,
    linear: Arc<dyn RunnableSkill>,
    client: Option<SkillClient>,
}

impl ConnectedMover {
    /// Connects to the robot, if it reaches the targets. `found` receives its endpoint.
    pub(super) async fn open(
        mover: &Mover,
        peers: &PeerAccess,
        targets: &[[f64; 3]],
        found: impl FnOnce(&str) + Send,
        work: &Work,
    ) -> Result<Self, KelvinError> {
        let partner = match mover {
            Mover::Skills { ptp, linear } => {
                return Ok(Self {
                    ptp: Arc::clone(ptp),
                    linear: Arc::clone(linear),
                    client: None,
                });
            }
            Mover::Component(partner) => partner,
        };
        let endpoint = tokio::select! {
            chosen = peers.carrier(partner.as_ref(), targets) => chosen?.endpoint,
            () = work.stopped() => return Err(KelvinError::Stopped),
        };
        found(&endpoint);
        let client = peers.connect(&endpoint).await?;
        match Self::with(&client).await {
            Ok((ptp, linear)) => Ok(Self {
                ptp,
                linear,
                client: Some(client),
            }),
            Err(fault) => {
                client.close().await;
                Err(PartnerError::Component { endpoint, fault }.into())
            }
        }
    }

    async fn with(
        client: &SkillClient,
    ) -> Result<(Arc<dyn RunnableSkill>, Arc<dyn RunnableSkill>), SkillFault> {
        let mut both: Vec<Arc<dyn RunnableSkill>> = Vec::new();
        // The robot is locked before the tool loses its supply, so that no other client moves it in
        // the middle of a change.
        for of in ["PtpMoveSkillType", "LinearMoveSkillType"] {
            let found = client.skills_of(&ParameterType::own(of)).await?;
            let first = found
                .first()
                .ok_or_else(|| SkillFault::Unexpected(format!("it has no {of}")))?;
            let skill = client.handle(first);
            if both.is_empty() {
                skill.lock("tool change").await?;
            }
            both.push(Arc::new(skill));
        }
        let both: [Arc<dyn RunnableSkill>; 2] = both
            .try_into()
            .map_err(|_| SkillFault::Unexpected("it has no moves".to_owned()))?;
        let [ptp, linear] = both;
        Ok((ptp, linear))
    }

    /// Moves the flange to each target in turn.
    pub(super) async fn go(
        &self,
        ways: &[Way],
        within: Duration,
        work: &Work,
    ) -> Result<(), KelvinError> {
        for &(step, straight, to) in ways {
            work.step(step).await;
            let skill = if straight { &self.linear } else { &self.ptp };
            let parameters = vec![("TargetPosition".to_owned(), SkillValue::from(to))];
            let outcome = match run_part(&**skill, parameters, within, work, work.stopped()).await {
                PartEnd::Ended(outcome) => outcome,
                PartEnd::Interrupted { halted, .. } => {
                    return Err(KelvinError::StoppedAt { step, halted });
                }
            };
            let outcome = outcome.map_err(|fault| KelvinError::Skill {
                step,
                skill: skill.name(),
                fault,
            })?;
            if !outcome.succeeded {
                return Err(KelvinError::Failed {
                    step,
                    skill: skill.name(),
                    message: outcome.message,
                });
            }
        }
        Ok(())
    }

    pub(super) async fn close(self) {
        if let Some(client) = self.client {
            client.close().await;
        }
    }
}
