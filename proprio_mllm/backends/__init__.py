"""Language models that answer chats: an OpenAI-compatible server, a model in this process, recorded replies, a script."""
