"""Planners that ask a language model in chats: plain prompting, LLM-Planner, RAP and DAG-Plan, on any backend."""
