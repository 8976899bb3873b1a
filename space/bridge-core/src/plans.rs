//! Cache of compiled plans that topics share.

use std::collections::HashMap;
use std::sync::{Arc, Weak};

use messages::{MessagePlan, MessageType, PlanError, Selection, TypeName, Wire};

/// The plans in use. They are shared, because thousands of topics may have the same type.
#[derive(Debug, Default)]
pub(crate) struct Plans {
    known: HashMap<(TypeName, Selection), CachedPlan>,
    /// The number of plans at which unused plans are removed.
    limit: usize,
}

#[derive(Debug)]
struct CachedPlan {
    /// The type from which the plan was compiled. A changed definition is a different
    /// `MessageType`.
    message_type: Weak<MessageType>,
    plan: Weak<MessagePlan>,
}

impl Plans {
    /// Returns the plan for a selection of the type. The plan is compiled unless another topic uses
    /// it.
    ///
    /// # Errors
    /// Returns a [`PlanError`] if the selection is not in the type.
    pub(crate) fn plan(
        &mut self,
        message_type: &Arc<MessageType>,
        selection: &Selection,
        wire: Wire,
    ) -> Result<Arc<MessagePlan>, PlanError> {
        let key = (message_type.name().clone(), selection.clone());
        let known = self.known.get(&key);
        if let Some(known) = known
            && known.message_type.as_ptr() == Arc::as_ptr(message_type)
            && let Some(plan) = known.plan.upgrade()
        {
            return Ok(plan);
        }
        let plan = Arc::new(MessagePlan::compile(message_type, selection, wire)?);
        if self.known.len() >= self.limit {
            self.known.retain(|_, known| known.plan.strong_count() > 0);
            self.limit = MIN_LIMIT.max(2 * self.known.len());
        }
        let known = CachedPlan {
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
    use messages::{Dialect, TypeRegistry};

    use super::*;

    #[test]
    fn topics_of_one_type_share_their_plan() {
        let read = || {
            let name: TypeName = "std_msgs/Header".parse().unwrap();
            TypeRegistry::bundle(Dialect::Ros2).get(&name).unwrap()
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
        // After another read of its definition, the type may have other fields.
        assert!(!Arc::ptr_eq(&first, &plan(&read(), &frame)));
    }
}
