//! Plans that topics share.

use std::collections::HashMap;
use std::sync::{Arc, Weak};

use messages::{MessageType, Plan, PlanError, Selection, TypeName, Wire};

/// The plans in use: thousands of topics may be of one type.
#[derive(Debug, Default)]
pub(crate) struct Plans {
    known: HashMap<(TypeName, Selection), Known>,
    /// How many there may be before those nobody has are looked for.
    limit: usize,
}

#[derive(Debug)]
struct Known {
    /// What it was made of, which is another after the type's definition has changed.
    message_type: Weak<MessageType>,
    plan: Weak<Plan>,
}

impl Plans {
    /// The plan for that part of the type, compiled unless another topic has it.
    ///
    /// # Errors
    /// [`PlanError`] when the selection is not in the type.
    pub(crate) fn plan(
        &mut self,
        message_type: &Arc<MessageType>,
        selection: &Selection,
        wire: Wire,
    ) -> Result<Arc<Plan>, PlanError> {
        let key = (message_type.name().clone(), selection.clone());
        let known = self.known.get(&key);
        if let Some(known) = known
            && known.message_type.as_ptr() == Arc::as_ptr(message_type)
            && let Some(plan) = known.plan.upgrade()
        {
            return Ok(plan);
        }
        let plan = Arc::new(Plan::compile(message_type, selection, wire)?);
        if self.known.len() >= self.limit {
            self.known.retain(|_, known| known.plan.strong_count() > 0);
            self.limit = MIN_LIMIT.max(2 * self.known.len());
        }
        let known = Known {
            message_type: Arc::downgrade(message_type),
            plan: Arc::downgrade(&plan),
        };
        self.known.insert(key, known);
        Ok(plan)
    }
}

const MIN_LIMIT: usize = 16;

#[cfg(test)]
mod tests {
    use messages::{Dialect, Registry};

    use super::*;

    #[test]
    fn topics_of_one_type_share_their_plan() {
        let read = || {
            let name: TypeName = "std_msgs/Header".parse().unwrap();
            Registry::bundle(Dialect::Ros2).get(&name).unwrap()
        };
        let known = read();
        let mut plans = Plans::default();
        let mut plan = |message_type, selection: &Selection| {
            plans.plan(message_type, selection, Wire::Cdr).unwrap()
        };
        let frame = Selection::Field("frame_id".to_owned());
        let first = plan(&known, &frame);
        assert!(Arc::ptr_eq(&first, &plan(&known, &frame)));
        assert!(!Arc::ptr_eq(&first, &plan(&known, &Selection::Whole)));
        // Read anew, it may have other fields.
        assert!(!Arc::ptr_eq(&first, &plan(&read(), &frame)));
    }
}
