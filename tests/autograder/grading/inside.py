"""What scripts begin with that tests run in a sandbox: how they say and hear, and what becomes of an attempt."""

PRELUDE = """
import ctypes, errno, json, os, signal, socket, sys, threading, time
channel = socket.socket(fileno=int(sys.argv[1]))
libc = ctypes.CDLL(None, use_errno=True)

def say(value):
    data = json.dumps(value).encode()
    channel.sendall(len(data).to_bytes(8, "big") + data)

def hear():
    length = int.from_bytes(channel.recv(8, socket.MSG_WAITALL), "big")
    return channel.recv(length, socket.MSG_WAITALL)

def outcome(function, *arguments):
    try:
        return repr(function(*arguments))
    except OSError as error:
        return errno.errorcode.get(error.errno, str(error))
    except BaseException as error:
        return type(error).__name__

def syscall(number, *arguments):
    result = libc.syscall(number, *arguments)
    return result if result >= 0 else errno.errorcode[ctypes.get_errno()]
"""
