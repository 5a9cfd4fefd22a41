"""DAG-Plan: one call for a graph, then both arms work it off without asking again.

With `reflection=off` that is all, as in the original: what fails is given up with what depends on it, the rest goes on, and the
episode ends with `Done()` (Table III, "without reflection"). With reflection, this paper's addition, a failure leads to one
call that gives cause, change and a fresh graph for what is left, at most `replans` times in an episode; where its reply is no
graph, and when no re-plan is left, the old graph goes on. A graph that breaks a rule goes back once with all that is wrong. A
second one that does, and a reply that is no graph at all, is an invalid reply; without a graph the next step asks anew.

Paper: baseline DAG-Plan of Tables II and III.
"""

from __future__ import annotations

import numpy as np

from interface.feedback import Feedback
from interface.observation import Observation
from proprio_mllm.planners.chat.asking import REFLECTION, Answer
from proprio_mllm.planners.chat.dag_plan.checks import GraphError, check_graph
from proprio_mllm.planners.chat.dag_plan.execution import Execution
from proprio_mllm.planners.chat.dag_plan.graph import Graph, GraphReply, RevisedGraph
from proprio_mllm.planners.chat.dag_plan.memory import Memory
from proprio_mllm.planners.chat.dag_plan.names import Vocabulary
from proprio_mllm.planners.chat.dag_plan.prompt import (
    GRAPH_FORM,
    GRAPH_RULES,
    REVISED_FORM,
    failure_text,
    graph_text,
    mending_text,
)
from proprio_mllm.planners.chat.planner import ChatPlanner
from proprio_mllm.planners.chat.replies import ReplyError
from proprio_mllm.planners.chat.view import encoded
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo

#: Purpose of the call that mends a graph.
_REPAIR = "repair"


class DagPlanner(ChatPlanner):
    """Plans a graph and carries it out."""

    def _start(self, task: TaskInfo, rng: np.random.Generator) -> None:
        self._system += f"\n\n{GRAPH_RULES}"
        self._memory = Memory()
        self._execution: Execution | None = None

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The next step of the graph, after asking for one where there is none or it has failed.

        Raises:
            BackendError: when the backend gives no reply.
        """
        execution, options = self._execution, self._options
        failed = execution is not None and execution.hear(feedback)
        self._memory.look(observation)
        before = self._look(observation)
        text = ""
        try:
            if execution is None:
                text, graph = self._ask(graph_text(observation, options, self._memory.hands), GraphReply, observation)
                execution = self._begin(graph, observation)
            elif failed and feedback is not None and self._reflects():
                question = failure_text(observation, options, self._memory.hands, feedback, before, execution.text())
                text, graph = self._ask(question, RevisedGraph, observation)
                execution = self._begin(graph, observation)
        except _NoGraphError as error:
            return self._asker.reply(error.text, None, str(error))
        step = execution.next(observation)
        return self._asker.reply(text or step.to_text(), step)

    def _begin(self, graph: Graph, observation: Observation) -> Execution:
        self._execution = Execution(graph, self._memory, observation, self._options.parallel)
        return self._execution

    def _ask(self, question: str, schema: type[GraphReply] | type[RevisedGraph], observation: Observation) -> tuple[str, Graph]:
        """One call for a graph, and one more to mend what breaks a rule; the reply's text and the graph.

        Raises:
            _NoGraphError: when there is none even so.
        """
        revised = schema is RevisedGraph
        system = f"{self._system}\n{REVISED_FORM if revised else GRAPH_FORM}"
        image = encoded(observation.image)
        answer = self._asker.ask(system, (question, image), schema, REFLECTION if revised else "plan")
        try:
            return answer.text, self._graph_of(answer, observation)
        except GraphError as error:
            question = mending_text(question, answer.text, error.problems)
        answer = self._asker.ask(system, (question, image), schema, REFLECTION if revised else _REPAIR)
        try:
            return answer.text, self._graph_of(answer, observation)
        except GraphError as error:
            raise _NoGraphError(str(error), answer.text) from None

    def _graph_of(self, answer: Answer[GraphReply | RevisedGraph], observation: Observation) -> Graph:
        """The graph of an answer.

        Raises:
            GraphError: when it breaks a rule.
            _NoGraphError: when there is none.
        """
        if answer.value is None:
            raise _NoGraphError(answer.error, answer.text)
        words = Vocabulary(observation.instruction, observation.known_objects)
        return check_graph(answer.value.nodes, words, self._memory.hands, self._memory.anchored)


class _NoGraphError(ReplyError):
    """A reply that is no graph, with its text."""

    def __init__(self, problem: str, text: str) -> None:
        super().__init__(problem)
        self.text = text
